"""Which frames of a sequence make a training clip."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from logvggt_jax.data.dataset import Dataset
from logvggt_jax.errors import InputError

Covisibility = Mapping[int, Sequence[tuple[int, float]]]


@runtime_checkable
class CovisibleDataset(Protocol):
    """A data set whose frames have no order in time: it says which of them see the same things."""

    def covisibility(self, sequence: str) -> Covisibility:
        """For each frame index its neighbours, (index, positive score) each; the larger, the more they share."""
        ...


@dataclass(frozen=True)
class ClipSampler:
    """Clips of evenly spaced frames in time order, with random stride, start and direction."""

    length: int  # frames of a clip
    # Smallest and largest distance between neighbouring frames; drawn uniformly from the strides with which a clip fits
    # into the sequence.
    stride: tuple[int, int] = (1, 1)
    reverse: float = 0.5  # probability that a clip runs backwards in time

    def __post_init__(self) -> None:
        _check_length(self.length)
        if len(self.stride) != 2 or not 1 <= self.stride[0] <= self.stride[1]:
            raise InputError(f"clip stride must be a pair 1 <= low <= high, got {self.stride}")
        if not 0 <= self.reverse <= 1:
            raise InputError(f"the probability of reversed clips must lie in [0, 1], got {self.reverse}")

    @property
    def shortest(self) -> int:
        """Frames that a sequence needs to hold a clip."""
        return (self.length - 1) * self.stride[0] + 1

    @property
    def requirement(self) -> str:
        """What a sequence needs to hold a clip, for messages."""
        return f"the {self.shortest} frames that clips of {self.length} with stride {self.stride[0]} need"

    def fits(self, dataset: Dataset, sequence: str) -> bool:
        """Whether a clip fits into the sequence."""
        return dataset.num_frames(sequence) >= self.shortest

    def draw(self, dataset: Dataset, sequence: str, rng: np.random.Generator) -> np.ndarray:
        """Frame indices [length] int64 of one clip of `sequence`."""
        return self.indices(dataset.num_frames(sequence), rng)

    def indices(self, num_frames: int, rng: np.random.Generator) -> np.ndarray:
        """Frame indices [length] int64 of one clip from a sequence of `num_frames` frames.

        Raises ValueError where no clip fits.
        """
        if num_frames < self.shortest:
            raise ValueError(
                f"a clip of {self.length} frames with stride {self.stride[0]} needs {self.shortest} frames, "
                f"the sequence has {num_frames}: shorten the clip or leave the sequence out"
            )
        widest = self.stride[1] if self.length == 1 else min(self.stride[1], (num_frames - 1) // (self.length - 1))
        stride = int(rng.integers(self.stride[0], widest + 1))
        span = (self.length - 1) * stride
        start = int(rng.integers(0, num_frames - span))
        clip = start + stride * np.arange(self.length)
        return clip[::-1].copy() if rng.random() < self.reverse else clip


@dataclass(frozen=True)
class CovisibilityWalk:
    """Clips of unordered photographs: a random walk over neighbours that visits no frame twice.

    The walk starts anywhere and goes on to a neighbour not yet visited, with a probability in proportion to its
    score. Where there is none it steps back to the last frame that still has one, so that every frame after the first
    sees something that an earlier one sees. Neighbourhood counts in both directions, with the larger score.
    """

    length: int  # frames of a clip

    def __post_init__(self) -> None:
        _check_length(self.length)

    @property
    def requirement(self) -> str:
        """What a sequence needs to hold a clip, for messages."""
        return f"the {self.length} frames connected by covisibility that clips of {self.length} need"

    def fits(self, dataset: Dataset, sequence: str) -> bool:
        """Whether a clip fits into the sequence."""
        if dataset.num_frames(sequence) < self.length:
            return False
        return bool(self._starts(_neighbours(_graph(dataset, sequence))))

    def draw(self, dataset: Dataset, sequence: str, rng: np.random.Generator) -> np.ndarray:
        """Frame indices [length] int64 of one clip of `sequence`."""
        return self.indices(_graph(dataset, sequence), rng)

    def indices(self, covisibility: Covisibility, rng: np.random.Generator) -> np.ndarray:
        """Frame indices [length] int64 of one walk; ValueError where no connected part has that many frames."""
        neighbours = _neighbours(covisibility)
        starts = self._starts(neighbours)
        if not starts:
            raise ValueError(
                f"a clip of {self.length} frames needs as many connected by covisibility, no part of the sequence "
                "has them: shorten the clip or leave the sequence out"
            )
        walk = [starts[int(rng.integers(len(starts)))]]
        visited, trail = set(walk), list(walk)
        while len(walk) < self.length:
            choices = [(frame, score) for frame, score in neighbours[trail[-1]].items() if frame not in visited]
            if not choices:
                trail.pop()
                continue
            scores = np.array([score for _, score in choices])
            chosen = choices[int(rng.choice(len(choices), p=scores / scores.sum()))][0]
            visited.add(chosen)
            walk.append(chosen)
            trail.append(chosen)
        return np.array(walk)

    def _starts(self, neighbours: Mapping[int, Mapping[int, float]]) -> list[int]:
        """Frames of the connected parts that are large enough."""
        starts: list[int] = []
        unseen = set(neighbours)
        while unseen:
            part = [unseen.pop()]
            for frame in part:
                reached = neighbours[frame].keys() & unseen
                unseen -= reached
                part.extend(reached)
            if len(part) >= self.length:
                starts.extend(part)
        return sorted(starts)


Sampler = ClipSampler | CovisibilityWalk
"""Chooses the frames of a clip."""


def sampler_for(dataset: Dataset, *, length: int, stride: tuple[int, int], reverse: float) -> Sampler:
    """A walk for a data set with `covisibility`, which has no order in time; evenly spaced clips for the others."""
    if isinstance(dataset, CovisibleDataset):
        return CovisibilityWalk(length)
    return ClipSampler(length, stride, reverse)


def example_rng(seed: int, index: int) -> np.random.Generator:
    """The random generator of training example `index`: a function of (`seed`, `index`) alone."""
    return np.random.default_rng([seed, index])


def _check_length(length: int) -> None:
    if length < 1:
        raise InputError(f"clip length must be at least 1, got {length}")


def _graph(dataset: Dataset, sequence: str) -> Covisibility:
    if not isinstance(dataset, CovisibleDataset):
        raise TypeError(f"{sequence}: a data set without covisibility cannot be walked; sample it in time order")
    return dataset.covisibility(sequence)


def _neighbours(covisibility: Covisibility) -> dict[int, dict[int, float]]:
    """Both directions of the graph, in a fixed order of frames; edges without a positive score are left out."""
    neighbours: dict[int, dict[int, float]] = {frame: {} for frame in sorted(covisibility)}
    for frame in sorted(covisibility):
        for other, score in covisibility[frame]:
            if score > 0 and other != frame:
                for a, b in ((frame, other), (other, frame)):
                    known = neighbours.setdefault(a, {})
                    known[b] = max(score, known.get(b, 0.0))
    return neighbours
