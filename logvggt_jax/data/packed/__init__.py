"""A reader's output in shards: written once, read back as the same data set, frame after frame of one file."""
