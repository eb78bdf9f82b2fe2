"""Ablations: one checkpoint run with parts switched off, other windows, or refinement at other times."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from logvggt_jax.config import ModelConfig
from logvggt_jax.errors import InputError
from logvggt_jax.evaluation.methods.method import Checkpoint, ClipPrediction, Method
from logvggt_jax.evaluation.streaming import (
    StreamedWindows,
    refined_cameras,
    stream_windows,
    without_refinement,
)
from logvggt_jax.model.logvggt import LogVGGT


@dataclasses.dataclass(frozen=True)
class Variant:
    """What differs from the full model: cross-window attention, and one refinement over all frames at the end.

    Attributes:
      label: of the row.
      windows: fields of `WindowConfig`.
      refinement: fields of `RefinementConfig`.
      online: refinement after every window.
    """

    label: str
    windows: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    refinement: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    online: bool = False

    def config(self, base: ModelConfig, *, limited_trunk: bool) -> ModelConfig:
        """A checkpoint's configuration, changed.

        Args:
          base: the checkpoint's.
          limited_trunk: whether the camera head's trunk sees frame 0 and the last K frames, K being the window's
            size, instead of all. A trunk over all frames is a global path of its own, beside which the others
            hardly show.
        """
        windows = dataclasses.replace(base.windows, **{"cross_window": True, **self.windows})
        refinement = {"enabled": True, "period": windows.stride if self.online else None, **self.refinement}
        refinement["context"] = windows.size if limited_trunk else None
        return dataclasses.replace(base, windows=windows, refinement=dataclasses.replace(base.refinement, **refinement))


# By the name that configurations use. Neighbours with the same windows share their runs.
VARIANTS: Mapping[str, Variant] = {
    "full": Variant("full"),
    "no_gccr": Variant("w/o GCCR", refinement={"enabled": False}),
    "gccr_every_50": Variant("GCCR every 50", refinement={"period": 50}),
    "gccr_every_100": Variant("GCCR every 100", refinement={"period": 100}),
    "gccr_online": Variant("GCCR online", online=True),
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
    """Every named variant twice: the camera head's trunk over all frames, and limited to K.

    All share the checkpoint's parameters; none was trained for what it changes. A variant that is the same model as
    an earlier one is left out.

    Args:
      checkpoint: whose sizes and parameters they have.
      names: of `VARIANTS`.

    Raises:
      InputError: a name that is not known.
    """
    for name in names:
        if name not in VARIANTS:
            raise InputError(f"variants: unknown {name!r}; known are {', '.join(VARIANTS)}")
    base, clips = checkpoint.model.config, _LastClip(checkpoint.variables)
    methods: dict[ModelConfig, Method] = {}
    for name in names:
        for limited in (False, True):
            variant = VARIANTS[name]
            config = variant.config(base, limited_trunk=limited)
            trunk = f"trunk {config.refinement.context}" if limited else "trunk all"
            knows = "its training" if config == base else "its training, which was not for this variant"
            predict = functools.partial(clips.predict, LogVGGT(config))
            identity = ["windows", config.to_dict(), checkpoint.digest]
            methods.setdefault(config, Method(f"{variant.label}, {trunk}", knows, predict, identity))
    return list(methods.values())


class _LastClip:
    """Runs variants; those that differ in refinement alone share the windows of a clip.

    Windows are nearly all of the cost. Only the last clip's output of the last windows is kept.
    """

    def __init__(self, variables: dict[str, Any]) -> None:
        self._variables = variables
        self._images: np.ndarray | None = None
        self._model: LogVGGT | None = None
        self._windows: StreamedWindows | None = None

    def predict(self, model: LogVGGT, images: np.ndarray) -> ClipPrediction:
        """The model's prediction of images [T, H, W, 3]; device memory does not grow with T, see `stream_clip`."""
        plain = without_refinement(model)
        if self._windows is None or self._images is not images or self._model != plain:
            self._windows = None  # before the next is made
            self._windows = stream_windows(plain, self._variables, images)
            self._images, self._model = images, plain
        cameras = refined_cameras(model, self._variables, self._windows)
        return ClipPrediction(self._windows.depth, *cameras)
