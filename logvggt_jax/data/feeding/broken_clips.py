"""Clips that could not be read: how many a run bears, and which they were."""

from collections.abc import Sequence
from typing import Any

from absl import logging

from logvggt_jax.errors import InputError, one_line

# The share is of this many clips at least, so that one broken file among the first few does not end a run.
FEWEST_CLIPS = 1000
_KEPT = 100


class TooManyBrokenClips(InputError):
    """More clips than allowed could not be read; lists them."""


class BrokenClips:
    """Counts the broken clips among those that were handed out.

    Attributes:
      count: broken clips so far.
      clips: all clips so far.
      messages: what was wrong with them, each once, the first hundred.
    """

    def __init__(self, max_share: float) -> None:
        self.max_share = max_share
        self.count = self.clips = 0
        self.messages: list[str] = []

    def add(self, messages: Sequence[str], *, clips: int) -> None:
        """Counts `clips` more clips and logs the broken ones among them.

        Raises TooManyBrokenClips if more than `max_share` of them are broken.
        """
        for message in messages:
            logging.warning("broken clip, replaced by the next one: %s", message)
            if message not in self.messages and len(self.messages) < _KEPT:
                self.messages.append(message)
        self.count += len(messages)
        self.clips += clips
        allowed = self.max_share * max(self.clips, FEWEST_CLIPS)
        if self.count > allowed:
            raise TooManyBrokenClips(
                f"{self.count} of {self.clips} clips were broken, max_broken={self.max_share:g} allows "
                f"{int(allowed)}: {'; '.join(self.messages)}; repair or remove these files, or raise max_broken"
            )

    def get_state(self) -> dict[str, Any]:
        """JSON values for `set_state`."""
        return {"count": self.count, "clips": self.clips, "messages": list(self.messages)}

    def set_state(self, state: dict[str, Any]) -> None:
        """Goes on counting where `get_state` was called."""
        self.count, self.clips, self.messages = int(state["count"]), int(state["clips"]), list(state["messages"])


def describe(error: Exception) -> str:
    """One line that says what was wrong; errors that are not made for readers are named by their type."""
    text = one_line(error)
    return text if isinstance(error, InputError) else f"{type(error).__name__}: {text}"
