"""VGGT without windows whose global blocks attend over merged tokens: FastVGGT, which needs no training of its own."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from logvggt_jax.config import require_one_of, require_within
from logvggt_jax.model.logvggt import LogVGGT, Variables, predictions_of
from logvggt_jax.model.merging import TokenMerging, merging_of
from logvggt_jax.model.parameters import run
from logvggt_jax.streaming.offline import (
    OfflineSession,
    OfflineSettings,
    PlainPrediction,
    of_one_sequence,
    plain_vggt,
)
from logvggt_jax.streaming.program import Program, abstract_variables, flops_of
from logvggt_jax.streaming.results import FrameResult, refuse_masks


@dataclasses.dataclass(frozen=True)
class MergedSettings(OfflineSettings):
    """What is merged, beside the limit of plain VGGT, which is wider here. The others' defaults are the published ones.

    Attributes:
      ratio: share of all tokens that is merged, at most; 0 is VGGT itself. With the published 0.9 every source that
        is not protected is merged, and a third of the tokens attends.
      protected: share of all tokens that is protected.
      similarity: type in which tokens are compared, `bfloat16` or `float32`.
    """

    max_frames: int | None = 1000
    ratio: float = 0.9
    protected: float = 0.1
    similarity: str = "bfloat16"

    def __post_init__(self) -> None:
        super().__post_init__()
        require_within(self, "[0, 1]", "ratio", "protected")
        require_one_of(self, ("bfloat16", "float32"), "similarity")


class MergedSession(OfflineSession):
    """Takes frames like an `OfflineSession` and predicts them in the same way, but for the merging.

    Args:
      model: whose parts are used; its windows are not.
      variables: {"params": …}.
      settings: what is merged.
    """

    def __init__(self, model: LogVGGT, variables: Variables, settings: MergedSettings) -> None:
        super().__init__(model, variables, settings)
        self._merging = settings

    def push(
        self, frames: np.ndarray | jax.Array | Sequence[np.ndarray], masks: np.ndarray | None = None
    ) -> list[FrameResult]:
        """Takes frames; see `Predictor.push`. It takes no masks: what is merged stands for all that went into it."""
        refuse_masks(masks, "offline")
        return super().push(frames)

    def _predict(self, images: np.ndarray, masks: np.ndarray | None) -> PlainPrediction:
        return predict_merged(self._model, self._variables, images, self._merging)


def predict_merged(
    model: LogVGGT, variables: Variables, images: np.ndarray, settings: MergedSettings
) -> PlainPrediction:
    """Prediction of images [n, H, W, 3] with merged tokens, in the frame of the first; compiled once for each n.

    Args:
      model: whose parts are used; its windows are not.
      variables: {"params": …}.
      images: uint8, or floating point in [0, 1].
      settings: what is merged.
    """
    merging = merging_for(model, len(images), images.shape[1:3], settings)
    return jax.device_get(_predict(plain_vggt(model, len(images)), variables, images, merging))


def merging_for(
    model: LogVGGT, num_frames: int, image_size: tuple[int, ...], settings: MergedSettings
) -> TokenMerging | None:
    """The tokens of so many frames of (H, W) pixels that are merged; None where none is."""
    return merging_of(
        num_frames,
        model.windows.grid((image_size[0], image_size[1])),
        model.config.aggregator.num_special,
        ratio=settings.ratio,
        protected=settings.protected,
        similarity=settings.similarity,
    )


@functools.partial(jax.jit, static_argnums=0)
def _predict(model: LogVGGT, variables: Variables, images: jax.Array, merging: TokenMerging | None) -> PlainPrediction:
    windows, size = model.windows, (images.shape[1], images.shape[2])
    mask = jnp.ones((1, len(images)), bool)
    tokens, _ = run(
        windows.aggregator,
        variables["params"]["aggregator"],
        windows.encode(variables, images[None]),
        None,
        mask[:, 0],
        merging,
        grid=windows.grid(size),
    )
    out = windows.decode_dense(variables, tokens, mask, size)
    encodings = model.refinement.refine_sequence(variables, out.camera_tokens, out.register_tokens, mask)
    return of_one_sequence(predictions_of(out, encodings, size))


def merged_program(
    model: LogVGGT, image_size: tuple[int, int], settings: MergedSettings, num_frames: int | None
) -> Program:
    """All frames at once; of a sequence whose length is not known, as many as are allowed."""
    count = num_frames or settings.max_frames or 1
    plain, variables = plain_vggt(model, count), abstract_variables(model.config)
    merging = merging_for(model, count, image_size, settings)
    images = jax.ShapeDtypeStruct((count, *image_size, 3), np.uint8)
    flops = flops_of(plain, lambda chosen: functools.partial(_predict, chosen), variables, images, merging)
    return Program(_predict.lower(plain, variables, images, merging), flops, count)
