"""A teacher, its labels on disk, and the data of a run with or without them."""
