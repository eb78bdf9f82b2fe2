"""Ablations: one checkpoint run with parts switched off, other windows, refinement at other times, or loops closed."""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from logvggt_jax.config import ModelConfig
from logvggt_jax.evaluation.methods.method import Checkpoint, ClipPrediction, Method, handed_out, model_row, scaled
from logvggt_jax.model.logvggt import LogVGGT, Variables
from logvggt_jax.streaming import ChunkPlan, StreamSession, WindowSettings
from logvggt_jax.streaming.pose_stream import in_one_mode


@dataclasses.dataclass(frozen=True)
class Variant:
    """What differs from the full model: cross-window attention, and one refinement over all frames at the end."""

    label: str  # of the row
    windows: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # fields of `WindowConfig`
    refinement: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # fields of `RefinementConfig`
    online: bool = False  # refinement after every window
    loops: bool = False  # loops closed at the end
    chained: bool = False  # windows that know nothing of one another, chained by what they say of the shared frames

    def config(self, base: ModelConfig, *, context: int | None = None) -> ModelConfig:
        """A checkpoint's configuration `base`, changed.

        `context` is how many frames the camera head's trunk sees beside frame 0; None for all. A trunk over all frames
        is a global path of its own, beside which the others hardly show.
        """
        windows = dataclasses.replace(base.windows, **{"cross_window": True, **self.windows})
        period = windows.stride if self.online else None
        refinement = {"enabled": True, "period": period, **self.refinement, "context": context}
        return dataclasses.replace(base, windows=windows, refinement=dataclasses.replace(base.refinement, **refinement))


# By the name that configurations use. Neighbours with the same windows share their runs.
VARIANTS: Mapping[str, Variant] = {
    "full": Variant("full"),
    "no_gccr": Variant("w/o GCCR", refinement={"enabled": False}),
    "gccr_every_50": Variant("GCCR every 50", refinement={"period": 50}),
    "gccr_every_100": Variant("GCCR every 100", refinement={"period": 100}),
    "gccr_online": Variant("GCCR online", online=True),
    "gccr_loops": Variant("GCCR with loops", loops=True),
    "windows_chained": Variant("relative chain of windows", chained=True),
    "no_cwa": Variant("w/o CWA", windows={"cross_window": False}),
    "no_cwa_no_gccr": Variant("w/o CWA and GCCR", windows={"cross_window": False}, refinement={"enabled": False}),
    "cache_output": Variant("cache of outputs", windows={"cache": "output"}),
    "cache_input": Variant("cache of inputs", windows={"cache": "input"}),
    "windows_2_1": Variant("K = 2, stride 1", windows={"size": 2, "stride": 1}),
    "windows_4_1": Variant("K = 4, stride 1", windows={"size": 4, "stride": 1}),
    "windows_4_2": Variant("K = 4, stride 2", windows={"size": 4, "stride": 2}),
    "windows_4_3": Variant("K = 4, stride 3", windows={"size": 4, "stride": 3}),
    "windows_8_2": Variant("K = 8, stride 2", windows={"size": 8, "stride": 2}),
    "windows_8_4": Variant("K = 8, stride 4", windows={"size": 8, "stride": 4}),
    "windows_16_8": Variant("K = 16, stride 8", windows={"size": 16, "stride": 8}),
}


def variant_methods(checkpoint: Checkpoint, names: Sequence[str]) -> list[Method]:
    """Every variant of these names twice: the camera head's trunk over all frames, and limited to K; chained windows
    once, whose trunk sees one window.

    All share the checkpoint's sizes and parameters; none was trained for what it changes. A variant that is the same
    model as an earlier one is left out. Names are those of `VARIANTS`.
    """
    base, clips = checkpoint.model.config, _SharedStream(checkpoint.variables)
    methods: dict[tuple[ModelConfig, bool] | str, Method] = {}
    for name in names:
        variant = VARIANTS[name]
        if variant.chained:
            plan = ChunkPlan(base.windows.size, base.windows.size - base.windows.stride)
            knows = "its training, which was not for this variant"
            methods[name] = model_row("chunks", checkpoint, plan, name=variant.label, knows=knows)
            continue
        for context in (None, variant.windows.get("size", base.windows.size)):
            config = variant.config(base, context=context)
            trunk = f"trunk {context or 'all'}"
            knows = "its training" if config == base else "its training, which was not for this variant"
            predict = functools.partial(clips.predict, config, loops=variant.loops)
            settings = WindowSettings(loops=True) if variant.loops else None
            row = model_row("windows", dataclasses.replace(checkpoint, model=LogVGGT(config)), settings, knows=knows)
            row = dataclasses.replace(row, name=f"{variant.label}, {trunk}", predict=predict)
            methods.setdefault((config, variant.loops), row)
    return list(methods.values())


class _SharedStream:
    """Runs variants; those that differ in refinement alone share the stream of a clip, which is nearly all of the cost.

    Only the last clip's stream is kept.
    """

    def __init__(self, variables: Variables) -> None:
        self._variables = variables
        self._last: tuple[np.ndarray, LogVGGT, bool, StreamSession, np.ndarray] | None = None

    def predict(self, config: ModelConfig, images: np.ndarray, *, loops: bool) -> ClipPrediction:
        """The variant's prediction of images [T, H, W, 3]."""
        model = in_one_mode(LogVGGT(config))
        if self._last is None or self._last[0] is not images or self._last[1:3] != (model, loops):
            self._last = None  # before the next is made
            session = StreamSession(model, self._variables, loops=loops)
            self._last = images, model, loops, session, handed_out(session, images)
        *_, session, depth = self._last
        cameras = session.cameras_with(config.refinement)
        return ClipPrediction(scaled(depth, cameras.depth_scale), cameras.extrinsics, cameras.intrinsics)
