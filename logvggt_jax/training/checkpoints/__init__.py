"""What a run goes on from, and the models that it leaves."""
