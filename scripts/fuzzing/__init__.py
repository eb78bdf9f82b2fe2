"""Damages valid inputs and watches what becomes of them; `scripts/fuzz.py` is the command."""
