"""The data sets of a run, opened, and their batches on the way to the devices."""
