"""From frames to training batches: clips, sizes, colours, mixtures, hold-outs, broken clips."""
