"""Methods that turn frames into predictions: one protocol, one registry.

Reconstruction, evaluation, timing and the command line open a method by its name: a published number is a number of the
code that users run. What needs more of windows than the protocol has (ablations, which try several modes of refinement
on one run of them, and live sequences) opens the class behind their name itself. A new method is a file of this folder
and a line of `METHODS`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import jax
import numpy as np

from logvggt_jax.config import ModelConfig
from logvggt_jax.errors import InputError
from logvggt_jax.model.logvggt import LogVGGT, Variables
from logvggt_jax.streaming.anchored_window import AnchoredWindowSettings, KeepWindow
from logvggt_jax.streaming.causal import CausalSettings, KeepAll
from logvggt_jax.streaming.chunks import ChunkPlan, ChunkSession, chunk_opening, chunk_program
from logvggt_jax.streaming.frame_session import FrameSession, Keeping, frame_program, tokens_a_frame
from logvggt_jax.streaming.merged import MergedSession, MergedSettings, merged_program
from logvggt_jax.streaming.offline import OfflineSession, OfflineSettings, offline_program
from logvggt_jax.streaming.program import Program
from logvggt_jax.streaming.pruned import KeepWanted, PrunedSettings
from logvggt_jax.streaming.results import Cameras, FrameResult, Progress, Signals
from logvggt_jax.streaming.rolling import KeepWithinBudget, RollingSettings
from logvggt_jax.streaming.windows import StreamSession, WindowSettings, window_opening, window_program


class Predictor(Protocol):
    """One sequence on its way through a method."""

    @property
    def num_frames(self) -> int:
        """Frames handed out so far."""
        ...

    @property
    def state_bytes(self) -> int:
        """Bytes of what is kept for the frames to come, on the device and the host; waits for the device.

        Empty places of buffers do not count, nor do parameters, what was handed out, and what a running program needs.
        """
        ...

    def push(
        self, frames: np.ndarray | jax.Array | Sequence[np.ndarray], masks: np.ndarray | None = None
    ) -> list[FrameResult]:
        """Takes frames and returns those that became final, oldest first.

        Args:
          frames: one frame [H, W, 3] or several [n, H, W, 3], uint8 or floating point in [0, 1]; H and W are
            multiples of the patch size and the same in every call, as is the dtype.
          masks: bool [H, W] of all these frames or [n, H, W], True for pixels that count; see `LogVGGT.apply`. A
            sequence has masks for all frames or for none.

        Raises:
          InputError: masks, and a method that takes none, see `Method.takes_masks`.
          ValueError: another shape or dtype, or the sequence is closed.
          PredictionError: the method cannot go on, for want of memory or of an alignment, or may not keep one frame.
        """
        ...

    def close(self, progress: Progress | None = None) -> list[FrameResult]:
        """Ends the sequence: the frames still held, oldest first. Afterwards every pose is final.

        Args:
          progress: told how many frames have been refined, of how many, where that takes a while.
        """
        ...

    def snapshot(self) -> tuple[list[FrameResult], dict[str, np.ndarray]]:
        """Waits for the device; the frames that are final by now, oldest first, and what `restore` needs to go on.

        A snapshot changes no number: a stream that goes on from one gives what it would have given.
        """
        ...

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Takes up a snapshot of the same method, model and settings; for a predictor that has seen no frame."""
        ...

    def cameras(self, *, provisional: bool = False) -> Cameras:
        """Cameras of the frames whose pose is final; with `provisional` of all frames handed out, as far as it can be
        said before the end. The stream goes on as if nothing had been asked."""
        ...

    def signals(self) -> Signals:
        """What the method tells of its own quality, of the frames handed out; most methods tell nothing."""
        ...


class Method(NamedTuple):
    """A line of the registry.

    Attributes:
      title: what tables call it.
      open: model, variables and settings to a predictor of one sequence.
      settings: the frozen dataclass of what can be set, all fields with defaults.
      trained_for: what its weights have to be trained for: `windows` (LoG-VGGT), `vggt` (plain VGGT) or `causal`
        (StreamVGGT).
      summary: what the method does, in a few words.
      program: model, (H, W) of the images, settings and number of frames (None: not known) to the program in which the
        method spends its time.
      takes_masks: whether `push` takes masks of pixels that are not to be seen.
      in_batches: whether many frames are predicted together, when all are there or a chunk is, so that the time of a
        single `push` tells nothing.
      check: configuration of a model, (H, W) of the images and settings; raises PredictionError where what the method
        keeps cannot hold one such frame.
      opening: of the same as `program` the programs, lowered, that a sequence without masks calls before its first
        result, as its calls find them where they are compiled; none where these cannot be told beforehand.
    """

    title: str
    open: Callable[[LogVGGT, Variables, Any], Predictor]
    settings: type
    trained_for: str
    summary: str
    program: Callable[[LogVGGT, tuple[int, int], Any, int | None], Program]
    takes_masks: bool = False
    in_batches: bool = False
    check: Callable[[ModelConfig, tuple[int, int], Any], None] = lambda config, image_size, settings: None
    opening: Callable[[LogVGGT, tuple[int, int], Any, int | None], list[jax.stages.Lowered]] = lambda *_: []

    def chosen(self, settings: Any) -> Any:
        """These settings, or the defaults where they are None."""
        return self.settings() if settings is None else settings


def _frame_by_frame(title: str, settings: type, keeping: Callable[[Any, int], Keeping], summary: str) -> Method:
    """A method whose frames pass one by one through what it keeps, made of its settings and the camera head's rounds.

    Its program is the step of the sequence's last frame, the costliest.
    """

    def kept(config: ModelConfig, chosen: Any) -> Keeping:
        return keeping(chosen, config.camera_head.iterations)

    def check(config: ModelConfig, image_size: tuple[int, int], chosen: Any) -> None:
        # Shapes alone: nothing is allocated.
        jax.eval_shape(lambda: kept(config, chosen).start(config, tokens_a_frame(config, image_size)))

    return Method(
        title,
        lambda model, variables, chosen: FrameSession(model, variables, kept(model.config, chosen), ahead=chosen.ahead),
        settings,
        "causal",
        summary,
        lambda model, size, chosen, num_frames: frame_program(model, size, kept(model.config, chosen), num_frames),
        check=check,
    )


METHODS: dict[str, Method] = {
    "windows": Method(
        "LoG-VGGT",
        StreamSession,
        WindowSettings,
        "windows",
        "overlapping windows that hand tokens on, poses refined globally",
        window_program,
        takes_masks=True,
        opening=window_opening,
    ),
    "offline": Method(
        "VGGT offline",
        OfflineSession,
        OfflineSettings,
        "vggt",
        "all frames in one window of full global attention",
        offline_program,
        takes_masks=True,
        in_batches=True,
    ),
    "chunks": Method(
        "VGGT on chunks",
        ChunkSession,
        ChunkPlan,
        "vggt",
        "overlapping chunks without memory, chained by robust similarities",
        chunk_program,
        takes_masks=True,
        in_batches=True,
        opening=chunk_opening,
    ),
    "merged": Method(
        "FastVGGT",
        MergedSession,
        MergedSettings,
        "vggt",
        "all frames at once, merged tokens in the global attention",
        merged_program,
        in_batches=True,
    ),
    "causal": _frame_by_frame(
        "StreamVGGT",
        CausalSettings,
        KeepAll,
        "each frame sees all before it through a cache of their keys and values",
    ),
    "anchored-window": _frame_by_frame(
        "STream3R's window",
        AnchoredWindowSettings,
        lambda settings, _: KeepWindow(settings.window),
        "each frame sees the first and the newest few through a cache",
    ),
    "rolling": _frame_by_frame(
        "InfiniteVGGT",
        RollingSettings,
        KeepWithinBudget,
        "a cache within a budget, which drops the keys that are most like the others",
    ),
    "pruned": _frame_by_frame(
        "XStreamVGGT",
        PrunedSettings,
        KeepWanted,
        "a cache in four bits of the first frame, the newest, and what the newest looks for",
    ),
}


def known_method(name: str) -> Method:
    """The method of this name; InputError where there is none."""
    if name not in METHODS:
        raise InputError(f"unknown method {name!r}; known are {', '.join(METHODS)}")
    return METHODS[name]


def open_predictor(method: str, model: LogVGGT, variables: Variables, settings: Any = None) -> Predictor:
    """A method's predictor for one sequence.

    Args:
      method: a name of `METHODS`.
      model: the model, whose parts the method uses.
      variables: {"params": …}.
      settings: of the method's own settings class; None for its defaults.

    Raises:
      InputError: the method is not known.
      ValueError: settings of another method.
    """
    found = known_method(method)
    settings = found.chosen(settings)
    if not isinstance(settings, found.settings):
        raise ValueError(f"method {method!r} takes {found.settings.__name__}, got {type(settings).__name__}")
    return found.open(model, variables, settings)
