"""What a clip or a prediction does not admit."""


class NotMeasurable(ValueError):
    """A metric has no value here: nothing valid, a value that is not finite, no similarity. The message says why.

    Evaluation lists the reason and leaves the clip out of that mean. Wrong arguments are plain ValueErrors: those are
    faults of the caller.
    """
