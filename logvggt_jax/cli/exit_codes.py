"""What the exit code of `logvggt` says, beside 0, and 128 and its number where a signal ended the run."""

OUTPUT_LOST = 1
PROBLEMS_FOUND = 1
BAD_INPUT = 2
