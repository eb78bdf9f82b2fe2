"""The rows of the tables: the model, references on the same weights, baselines, ablations."""
