"""The one error that entry points shorten to a line."""

from __future__ import annotations


class InputError(ValueError):
    """What a user gave cannot be used: a file, a folder, a setting, an option.

    The message is one line that says what is wrong, where, and how to mend it. Entry points print it and exit;
    any other exception is a fault of this package and keeps its traceback.
    """
