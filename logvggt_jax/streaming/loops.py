"""Loops: places that a sequence comes back to are found, checked, and cameras and depth of all frames corrected.

While a sequence streams, every so many frames a place is kept: image, and depth on a coarse grid. When it ends

1. the encoder's patch tokens, pooled, say which places look alike (no second network);
2. the model predicts the frames around both places of a candidate together, and `loop_check` compares that with what
   each place has by itself;
3. `pose_graph` finds the similarities of all stretches of the sequence that fit the loops which passed;
4. cameras move, and depth gets a factor a frame.

Without a loop that passes, nothing changes.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
import numpy as np

from logvggt_jax.config import require_counts, require_within
from logvggt_jax.geometry import camera_centres, matrix_to_quaternion, scale_of, similarity_exp, similarity_log
from logvggt_jax.model.logvggt import LogVGGT, Variables
from logvggt_jax.model.masks import seen_patches
from logvggt_jax.streaming.loop_check import check_loop
from logvggt_jax.streaming.offline import PlainPrediction
from logvggt_jax.streaming.pose_graph import Edges, optimise
from logvggt_jax.streaming.results import Cameras, FrameResult, PredictionError

# The longer edge of the grid on which a place's depth is kept.
_GRID = 96
# A loop that the others contradict ends with a weight below this.
_LEAST_WEIGHT = 0.5
# Places that the encoder describes in one call.
_AT_ONCE = 8


@dataclasses.dataclass(frozen=True)
class LoopSettings:
    """How loops are looked for.

    Attributes:
      spacing: frames from one place that is kept to the next, at first.
      max_places: places kept; when there are more, every second goes and the spacing doubles. One takes 3 bytes a pixel
        of its image and at most 74 kB of depth and confidence: 0.66 MB at 392 x 518 pixels. Their descriptors, 4 · C
        bytes each, exist while loops are closed.
      gap: frames between the two ends of a loop, at least.
      similarity: of the places' descriptors, in [-1, 1], below which a pair is no candidate.
      max_candidates: pairs that are checked, the most similar first; each costs a run of the model.
      frames: places around each end that are predicted together with those around the other.
      stretch: frames that move as one, of a stream that has no chunks; between their beginnings the correction is
        interpolated.
    """

    spacing: int = 5
    max_places: int = 512
    gap: int = 60
    similarity: float = 0.5
    max_candidates: int = 32
    frames: int = 5
    stretch: int = 30

    def __post_init__(self) -> None:
        require_counts(self, "spacing", "max_candidates", "frames", "stretch")
        require_counts(self, "max_places", "gap", least=3)
        require_within(self, "[-1, 1]", "similarity")


def loop_settings(asked: LoopSettings | bool) -> LoopSettings | None:
    """Settings of loops as a method's own settings hold them: True for the defaults, False for none."""
    if isinstance(asked, LoopSettings):
        return asked
    return LoopSettings() if asked else None


@dataclasses.dataclass
class _Place:
    """A frame that may be come back to, and its mask where it has one; depth and confidence [h, w] on the grid come
    when they are final."""

    image: np.ndarray
    mask: np.ndarray | None = None
    depth: np.ndarray | None = None
    confidence: np.ndarray | None = None


class LoopCloser:
    """Keeps a sequence's places, and closes its loops when it has ended.

    Args:
      describe: images [n, H, W, 3], and their masks bool [n, H, W] where they have some, to descriptors [n, C].
      predict: the same to a prediction of all of them together.
      settings: how loops are looked for.
    """

    def __init__(
        self,
        describe: Callable[..., np.ndarray],
        predict: Callable[..., PlainPrediction],
        settings: LoopSettings,
    ) -> None:
        self._describe, self._predict, self._settings = describe, predict, settings
        self._places: dict[int, _Place] = {}
        self._spacing, self._seen = settings.spacing, 0

    def see(self, image: np.ndarray, mask: np.ndarray | None = None) -> None:
        """Takes the next frame's image [H, W, 3] and mask bool [H, W]; all frames have one, or none has."""
        if self._seen % self._spacing == 0:
            self._places[self._seen] = _Place(image.copy(), None if mask is None else mask.copy())
        self._seen += 1
        if len(self._places) > self._settings.max_places:
            self._spacing *= 2
            self._places = {index: place for index, place in self._places.items() if index % self._spacing == 0}

    def take(self, results: list[FrameResult]) -> None:
        """Takes the depth of frames that were seen, in the unit of the cameras that `close` gets."""
        for result in results:
            if (place := self._places.get(result.index)) is not None:
                step = _grid_step(result.depth.shape)
                place.depth = result.depth[::step, ::step].astype(np.float32)
                place.confidence = result.confidence[::step, ::step].astype(np.float32)

    def close(self, cameras: Cameras) -> Cameras:
        """The cameras of all frames with loops closed, the factors of their depth, and the loops.

        Raises:
          PredictionError: the sequence has fewer than three frames.
        """
        if self._seen < 3:
            raise PredictionError(
                f"a loop needs at least three frames, this sequence has {self._seen}: give a longer one, or leave "
                "loops out"
            )
        found = self._loops(cameras)
        if not found:
            return cameras._replace(loops=np.zeros((0, 2), np.int64))
        pairs, relative = np.array([pair for pair, _ in found]), np.stack([each for _, each in found])
        anchors = np.arange(0, self._seen, self._settings.stretch)
        nodes = self._nodes(cameras, anchors)
        first, second = (pairs // self._settings.stretch).T
        measured = np.linalg.inv(nodes[first]) @ relative @ nodes[second]
        moved, weights = optimise(nodes, Edges(first, second, measured))
        believed = weights >= _LEAST_WEIGHT
        if not believed.any():
            return cameras._replace(loops=np.zeros((0, 2), np.int64))
        if not believed.all():
            moved, _ = optimise(nodes, Edges(first[believed], second[believed], measured[believed]))
        corrections = _between(moved @ np.linalg.inv(nodes), anchors, self._seen)
        return _corrected(cameras, corrections)._replace(loops=pairs[believed])

    def arrays(self) -> dict[str, np.ndarray]:
        """All places, for `restore`."""
        arrays = {"counts": np.array([self._seen, self._spacing])}
        if not self._places:
            return arrays
        known = {index: place for index, place in self._places.items() if place.depth is not None}
        arrays["indices"] = np.array(list(self._places))
        images, *masks = _stacked(list(self._places.values()))
        arrays |= {"images": images, **({"masks": masks[0]} if masks else {})}
        arrays["known"] = np.array(list(known), np.int64)
        for name in ("depth", "confidence") if known else ():
            arrays[name] = np.stack([getattr(place, name) for place in known.values()])
        return arrays

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Takes up what `arrays` gave."""
        self._seen, self._spacing = (int(count) for count in arrays["counts"])
        if "indices" not in arrays:
            return
        masks = arrays.get("masks", [None] * len(arrays["images"]))
        places = zip(arrays["indices"].tolist(), arrays["images"], masks, strict=True)
        self._places = {index: _Place(image, mask) for index, image, mask in places}
        for position, index in enumerate(arrays["known"].tolist()):
            place = self._places[index]
            place.depth, place.confidence = arrays["depth"][position], arrays["confidence"][position]

    def _loops(self, cameras: Cameras) -> list[tuple[tuple[int, int], np.ndarray]]:
        """Loops that passed: frames of both ends, and what carries the world at the second onto that at the first."""
        indices = np.array(list(self._places))
        places = list(self._places.values())
        parts = [places[start : start + _AT_ONCE] for start in range(0, len(places), _AT_ONCE)]
        # The last call is filled up, so that one program describes all.
        filled = [part + part[-1:] * (_AT_ONCE - len(part)) for part in parts]
        described = [self._describe(*_stacked(full))[: len(part)] for part, full in zip(parts, filled, strict=True)]
        size = min(self._settings.frames, len(indices) // 2)
        gap = max(self._settings.gap, 2 * size * self._spacing)
        found = []
        for ends in candidates(np.concatenate(described), indices, self._settings, gap=gap):
            around = [indices[_around(end, size, len(indices))] for end in ends]
            own = [self._own(each, cameras) for each in around]
            joint = self._predict(*_stacked([self._places[index] for index in np.concatenate(around)]))
            check = check_loop(_on_grid(joint), *own)
            pair = int(indices[ends[0]]), int(indices[ends[1]])
            if check.passed and pair[0] // self._settings.stretch != pair[1] // self._settings.stretch:
                assert check.relative is not None  # where it passed
                found.append((pair, check.relative))
        return found

    def _own(self, indices: np.ndarray, cameras: Cameras) -> PlainPrediction:
        """What the sequence says of some places, on the grid."""
        places = [self._places[index] for index in indices]
        step = _grid_step(places[0].image.shape[:2])
        return PlainPrediction(
            depth=np.stack([place.depth for place in places if place.depth is not None]),
            depth_confidence=np.stack([place.confidence for place in places if place.confidence is not None]),
            extrinsics=cameras.extrinsics[indices],
            intrinsics=_coarser(cameras.intrinsics[indices], step),
        )

    def _nodes(self, cameras: Cameras, anchors: np.ndarray) -> np.ndarray:
        """Frames of reference [N, 4, 4] of the stretches: their first cameras, the depth seen there as the unit."""
        indices = np.array(list(self._places))
        extrinsics = cameras.extrinsics[anchors].astype(np.float64)
        nodes = np.tile(np.eye(4), (len(anchors), 1, 1))
        nodes[:, :3, 3] = camera_centres(extrinsics)
        for node, anchor, rotation in zip(nodes, anchors, extrinsics[:, :, :3], strict=True):
            depth = self._places[int(indices[np.abs(indices - anchor).argmin()])].depth
            assert depth is not None  # all frames are final
            valid = depth[np.isfinite(depth) & (depth > 0)]
            node[:3, :3] = rotation.T * (float(np.median(valid)) if valid.size else 1.0)
        return nodes


def _stacked(places: list[_Place]) -> list[np.ndarray]:
    """The places' images [n, H, W, 3], and their masks [n, H, W] where they have some."""
    masks = [place.mask for place in places if place.mask is not None]
    return [np.stack(arrays) for arrays in ([place.image for place in places], masks) if arrays]


def frame_describer(model: LogVGGT, variables: Variables) -> Callable[..., np.ndarray]:
    """Images [n, H, W, 3], and masks bool [n, H, W] where there are some, to descriptors [n, C] float32: the mean of
    the encoder's tokens of the patches that are seen."""
    return lambda images, masks=None: np.asarray(_pooled(model, variables, images, masks))


@functools.partial(jax.jit, static_argnums=0)
def _pooled(model: LogVGGT, variables: Variables, images: jax.Array, masks: jax.Array | None) -> jax.Array:
    if masks is None:
        return jnp.mean(model.windows.encode(variables, images[None])[0], axis=1)
    tokens = model.windows.encode(variables, images[None], masks[None])[0]
    seen = seen_patches(masks, model.config.encoder.patch_size)
    assert seen is not None  # of masks
    return jnp.sum(tokens * seen[..., None], axis=1) / jnp.maximum(seen.sum(1), 1)[:, None]


def candidates(
    descriptors: np.ndarray, indices: np.ndarray, settings: LoopSettings, *, gap: int
) -> list[tuple[int, int]]:
    """Pairs of places that look alike, the most similar first, at most `settings.max_candidates`.

    Descriptors are compared by the cosine of what differs from their mean: what all frames of a sequence share says
    nothing of the place. A pair is a candidate if each is the other's best at a distance of `gap` frames or more; of
    pairs whose both ends are closer than a quarter of that, the best stays. The cost is P² · C operations for P places.

    Args:
      descriptors: [P, C].
      indices: [P], the places' frames, ascending.
      settings: how loops are looked for.
      gap: frames between both ends, at least.

    Returns:
      Positions among the places, the earlier first.
    """
    centred = descriptors - descriptors.mean(0)
    centred /= np.maximum(np.linalg.norm(centred, axis=1, keepdims=True), 1e-12)
    far = np.abs(indices[:, None] - indices) >= gap
    alike = np.where(far, centred @ centred.T, -np.inf)
    best, positions = alike.argmax(1), np.arange(len(indices))
    mutual = positions[(best[best] == positions) & (positions < best) & far[positions, best]]
    mutual = mutual[alike[mutual, best[mutual]] >= settings.similarity]
    chosen: list[tuple[int, int]] = []
    for first in mutual[np.argsort(-alike[mutual, best[mutual]], kind="stable")].tolist():
        pair = first, int(best[first])
        taken = np.array([indices[list(other)] for other in chosen]).reshape(-1, 2)
        if not (np.abs(taken - indices[list(pair)]) < gap / 4).all(1).any():
            chosen.append(pair)
    return chosen[: settings.max_candidates]


def _around(position: int, size: int, count: int) -> slice:
    """So many places about one of `count`, as evenly as the ends allow."""
    start = min(max(position - size // 2, 0), count - size)
    return slice(start, start + size)


def _grid_step(size: tuple[int, ...]) -> int:
    return -(-max(size) // _GRID)


def _on_grid(prediction: PlainPrediction) -> PlainPrediction:
    step = _grid_step(prediction.depth.shape[1:])
    return PlainPrediction(
        depth=prediction.depth[:, ::step, ::step],
        depth_confidence=prediction.depth_confidence[:, ::step, ::step],
        extrinsics=prediction.extrinsics,
        intrinsics=_coarser(prediction.intrinsics, step),
    )


def _coarser(intrinsics: np.ndarray, step: int) -> np.ndarray:
    """Intrinsics [n, 3, 3] for every `step`-th pixel; centres at integers, the first pixel stays."""
    return intrinsics * np.array([[1 / step], [1 / step], [1.0]], intrinsics.dtype)


def _between(corrections: np.ndarray, anchors: np.ndarray, count: int) -> np.ndarray:
    """Corrections [count, 4, 4] of all frames, of those [N, 4, 4] at `anchors`; constant after the last."""
    frames = np.arange(count)
    node = np.searchsorted(anchors, frames, side="right") - 1
    steps = np.zeros((len(anchors), 7))
    steps[:-1] = similarity_log(np.linalg.inv(corrections[:-1]) @ corrections[1:])
    share = (frames - anchors[node]) / np.diff(anchors, append=anchors[-1] + count)[node]
    return corrections[node] @ similarity_exp(share[:, None] * steps[node])


def _corrected(cameras: Cameras, corrections: np.ndarray) -> Cameras:
    """Cameras after `corrections` [N, 4, 4] have moved the world, each as its frame sees it."""
    scale = scale_of(corrections)
    rotation = corrections[:, :3, :3] / scale[:, None, None]
    extrinsics = cameras.extrinsics.astype(np.float64)
    turned = extrinsics[:, :, :3] @ rotation.swapaxes(1, 2)
    shifted = scale[:, None] * extrinsics[:, :, 3] - (turned @ corrections[:, :3, 3, None])[..., 0]
    moved = np.concatenate([turned, shifted[..., None]], axis=-1).astype(np.float32)
    encodings = cameras.pose_encoding.copy()
    encodings[:, :3], encodings[:, 3:7] = moved[:, :, 3], matrix_to_quaternion(moved[:, :, :3])
    return cameras._replace(pose_encoding=encodings, extrinsics=moved, depth_scale=scale.astype(np.float32))
