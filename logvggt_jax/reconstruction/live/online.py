"""The mode in which a stream costs the same at any length."""

from __future__ import annotations

import dataclasses

from logvggt_jax.config import require_counts
from logvggt_jax.errors import InputError
from logvggt_jax.model.logvggt import LogVGGT, Variables
from logvggt_jax.streaming import StreamSession


@dataclasses.dataclass(frozen=True)
class OnlineSettings:
    """What is kept of the past, see `logvggt_jax.config.RefinementConfig`.

    Attributes:
      period: new frames after which poses become final; None for the windows' stride: every window.
      context: newest frames that the camera head sees besides the first.
      max_registers: register tokens that the refinement reads, four a frame.
    """

    period: int | None = None
    context: int = 32
    max_registers: int = 1024

    def __post_init__(self) -> None:
        require_counts(self, "period", "context", "max_registers")

    def text(self, model: LogVGGT) -> str:
        """What they mean for a model, in one line."""
        window = model.config.windows
        return (
            f"windows of {window.size} frames, {window.stride} of them new; poses are final every "
            f"{self.period or window.stride} frames, from the newest {self.context} frames and {self.max_registers} "
            "register tokens: time and memory of the device do not grow"
        )


def online_stream(
    model: LogVGGT, variables: Variables, settings: OnlineSettings = OnlineSettings(), *, provisional: bool = False
) -> StreamSession:
    """A stream of constant cost, whose results come as soon as the device has them.

    Args:
      model: the model; its own refinement's mode is replaced.
      variables: {"params": …}.
      settings: what is kept of the past.
      provisional: give frames whose pose is not final yet, with a `period` longer than the windows' stride, the pose
        that they would have if the stream ended now; costs a run of the camera head at every window.

    Raises:
      InputError: the context is smaller than the windows' stride.
    """
    stride = model.config.windows.stride
    if settings.context < stride:
        raise InputError(f"context must be at least the windows' stride, {stride} frames, got {settings.context}")
    refinement = dataclasses.replace(
        model.config.refinement,
        period=settings.period or stride,
        context=settings.context,
        max_registers=settings.max_registers,
    )
    return StreamSession(
        LogVGGT(dataclasses.replace(model.config, refinement=refinement)), variables, ahead=0, provisional=provisional
    )
