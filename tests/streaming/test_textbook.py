"""The methods at sizes of which nobody has stored numbers, against an account of them in numpy, see `textbook.py`:
few and many heads, grids that are far from square, budgets and caps of every kind."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
import pytest
import textbook
from textbook import Everything, FirstAndNewest, Network, Pruned, Rolling

from logvggt_jax import LogVGGT, ModelConfig
from logvggt_jax.config import AggregatorConfig, CameraHeadConfig, DPTConfig, EncoderConfig, RefinementConfig
from logvggt_jax.doctor.subject import random_variables
from logvggt_jax.model.windows import Windows
from logvggt_jax.streaming import (
    AnchoredWindowSettings,
    CausalSettings,
    MergedSettings,
    OfflineSettings,
    PrunedSettings,
    RollingSettings,
    open_predictor,
)
from logvggt_jax.streaming.merged import merging_for

FRAMES = 7
POSES = 5e-5  # where poses reach 8
# In 4 bits, which move poses by 3e-2 and more: a code that the last digit of a number tips over is a step off.
CODED_POSES = 5e-3
# In float32 a choice between scores that are nearer may fall otherwise.
LEAST_GAP = 1e-5


@dataclasses.dataclass(frozen=True)
class Subject:
    """A network of random parameters, and the frames that it sees."""

    config: ModelConfig
    variables: Any
    params: Any  # the same, float64
    images: np.ndarray
    patches: np.ndarray  # [T, h · w, C] float64, the encoder's tokens
    grid: tuple[int, int]

    @property
    def tokens(self) -> int:
        """P."""
        return 1 + self.config.aggregator.num_registers + self.grid[0] * self.grid[1]


def _config(width: int, heads: int, depth: int, registers: int, head: tuple[int, int, int], gccr: int) -> ModelConfig:
    """With a camera head of so many blocks, heads and rounds, and so many heads of GCCR, none of which is none."""
    return ModelConfig(
        encoder=EncoderConfig(width, 1, heads, position_grid=4),
        aggregator=AggregatorConfig(depth, heads, num_registers=registers, key_layers=(0, 1, depth - 2, depth - 1)),
        camera_head=CameraHeadConfig(*head),
        depth_head=DPTConfig(8, (8, 8, 8, 8)),
        refinement=RefinementConfig(bool(gccr), num_heads=max(gccr, 1)),
    )


# Runs of 16 patches: less than one, one and four more, two and a half.
SIZES = {
    "10 patches, heads of 12": (_config(36, 3, 5, 4, (2, 4, 3), 6), (2, 5)),
    "20 patches, heads of 4": (_config(32, 8, 4, 4, (1, 2, 4), 0), (5, 4)),
    "40 patches, one head, two registers": (_config(24, 1, 6, 2, (1, 3, 2), 1), (2, 20)),
}
FEW, SOME, MANY = SIZES


@pytest.fixture(scope="module")
def subjects() -> dict[str, Subject]:
    """Those that have been asked for."""
    return {}


def _subject(subjects: dict[str, Subject], name: str) -> Subject:
    if name not in subjects:
        config, grid = SIZES[name]
        variables = random_variables(LogVGGT(config), scale=0.2)
        shape = (FRAMES, 14 * grid[0], 14 * grid[1], 3)
        images = np.random.default_rng(1).integers(0, 256, shape, np.uint8)
        patches = np.asarray(jax.jit(Windows(config).encode)(variables, images[None]), np.float64)[0]
        params = jax.tree.map(lambda x: np.asarray(x, np.float64), variables["params"])
        subjects[name] = Subject(config, variables, params, images, patches, grid)
    return subjects[name]


def _poses(subject: Subject, method: str, settings: Any, frames: int = FRAMES) -> tuple[np.ndarray, Any]:
    """Pose encodings [T, 9], and what the method kept before it was closed."""
    predictor: Any = open_predictor(method, LogVGGT(subject.config), subject.variables, settings)
    results = [result for image in subject.images[:frames] for result in predictor.push(image)]
    memory = jax.device_get(getattr(predictor, "_memory", None))
    results += predictor.close()
    return np.stack([result.pose_encoding for result in results]), memory


def _network(subject: Subject, method: str, settings: Any) -> Network:
    """Its account in numpy."""
    sizes, tokens = subject.config.aggregator, subject.tokens

    def of_layers(memory: Callable[[], Any]) -> list[Any]:
        return [memory() for _ in range(sizes.depth)]

    kept: dict[str, Any] = {
        "layers": of_layers(Everything),
        "trunk": Everything,
        "registers": lambda t: list(range(t + 1)),
        "single": getattr(settings, "camera_cache", "per_round") == "single",
    }
    if method == "anchored-window":
        few = functools.partial(FirstAndNewest, settings.window)
        registers = lambda t: [i for i in range(t + 1) if i == 0 or i > t - settings.window]  # noqa: E731
        kept |= {"layers": of_layers(few), "trunk": few, "registers": registers}
    if method == "rolling":
        kept["layers"] = of_layers(functools.partial(Rolling, settings.anchor))
    if method == "pruned":
        wanted = functools.partial(Pruned, settings.cap)
        layer = functools.partial(wanted, 1 + sizes.num_registers, codes=settings.bits == 4)
        fit = max(settings.cap, 2 * tokens) // tokens
        registers = lambda t: [i for i in range(t + 1) if i == 0 or i > t + 1 - fit]  # noqa: E731
        kept |= {"layers": of_layers(layer), "trunk": functools.partial(wanted, 1), "registers": registers}
    return Network(subject.config, subject.params, subject.grid, **kept)


def _in_numpy(subject: Subject, method: str, settings: Any) -> tuple[np.ndarray, Network]:
    network, found = _network(subject, method, settings), []
    for patches in subject.patches:
        if method == "rolling":
            least = max(settings.anchor * subject.tokens, 1)
            scores = [layer.score for layer in network.layers]
            for layer, budget in zip(
                network.layers, textbook.budgets(scores, settings.budget, settings.temperature), strict=True
            ):
                layer.budget = max(budget, least)
        found.append(network.frame(patches))
    return np.stack(found), network


def _slow(*case: Any) -> Any:
    return pytest.param(*case, marks=pytest.mark.slow)


@pytest.mark.parametrize(
    ("size", "method", "settings"),
    [
        _slow(MANY, "causal", CausalSettings("single", first_capacity=1)),
        _slow(SOME, "causal", CausalSettings()),
        (SOME, "anchored-window", AnchoredWindowSettings(window=1)),
        _slow(MANY, "anchored-window", AnchoredWindowSettings(window=3)),
        # Budgets of all layers together: some below a frame, without an anchor, of a frame, with two frames as anchor.
        (FEW, "rolling", RollingSettings(int(3.4 * 15 * 5), temperature=0.1)),
        _slow(SOME, "rolling", RollingSettings(int(2.6 * 25 * 4), temperature=1.0, anchor=0, camera_cache="single")),
        _slow(MANY, "rolling", RollingSettings(43 * 6, temperature=0.1)),
        _slow(FEW, "rolling", RollingSettings(int(3.3 * 15 * 5), anchor=2, first_capacity=2)),
        # Caps: of a frame, of two and a half, beyond all; the camera head's entries are as many at most.
        (SOME, "pruned", PrunedSettings(2 * 25 + 13, 16)),
        _slow(FEW, "pruned", PrunedSettings(15, 16, "single")),
        _slow(MANY, "pruned", PrunedSettings(2 * 43 + 20, 16, first_capacity=1)),
        _slow(FEW, "pruned", PrunedSettings(10_000, 4)),
        _slow(MANY, "pruned", PrunedSettings(10_000, 4, first_capacity=2)),
    ],
)
def test_a_stream_is_the_textbooks(size: str, method: str, settings: Any, subjects: dict[str, Subject]) -> None:
    """Poses of all frames, and the keys and values that each layer holds at the end."""
    subject = _subject(subjects, size)
    expected, network = _in_numpy(subject, method, settings)
    gap = min(getattr(layer, "gap", np.inf) for layer in network.layers)
    assert gap > LEAST_GAP, "choose other numbers: float32 cannot tell these apart"
    found, memory = _poses(subject, method, settings)
    coded = getattr(settings, "bits", 16) == 4
    np.testing.assert_allclose(found, expected, rtol=0, atol=CODED_POSES if coded else POSES)
    for layer, cache in zip(network.layers, memory.blocks.layers, strict=True):
        if method == "rolling":
            heads = [np.array([key for key, _ in held]) for held in layer.heads]
            held = np.stack(heads, axis=1)
        elif method == "pruned":
            held = np.stack([key for key, _ in layer.held])
        else:
            held = np.concatenate([key for key, _ in layer.seen()])
        assert len(held) == min(int(cache.length), cache.capacity)
        if method != "anchored-window":  # whose ring is in another order
            key = jax.jit(lambda x: x.opened("float32")[0])(cache) if coded else cache.key
            apart = np.abs(key[0, : len(held)] - held) > 1e-4
            assert apart.mean() <= (0.01 if coded else 0)


def test_pruning_in_4_bits_is_the_textbooks_as_long_as_no_code_tips_over(subjects: dict[str, Subject]) -> None:
    """Of the first frames too little to show; later ones prune by what came of it."""
    subject, settings = _subject(subjects, FEW), PrunedSettings(37)
    expected, _ = _in_numpy(subject, "pruned", settings)
    found, _ = _poses(subject, "pruned", settings)
    np.testing.assert_allclose(found[:4], expected[:4], rtol=0, atol=CODED_POSES)
    unpruned, _ = _in_numpy(subject, "pruned", PrunedSettings(10_000))
    assert np.abs(unpruned - expected)[3].max() > 2 * CODED_POSES, "what is pruned shows"


@pytest.mark.parametrize("frames", [_slow(1), 2, _slow(5)])
@pytest.mark.parametrize(("size", "ratio"), [(FEW, 0.9), _slow(SOME, 0.9), _slow(MANY, 0.2)])
def test_merging_is_the_textbooks(size: str, ratio: float, frames: int, subjects: dict[str, Subject]) -> None:
    subject = _subject(subjects, size)
    settings = MergedSettings(ratio=ratio, similarity="float32")
    merging = merging_for(LogVGGT(subject.config), frames, subject.images.shape[1:3], settings)
    given = (
        None
        if merging is None
        else (*map(np.asarray, (merging.sources, merging.destinations, merging.protected)), merging.merged)
    )
    arguments = subject.config, subject.params, subject.grid, subject.patches[:frames]
    expected, plain = textbook.offline(*arguments, given), textbook.offline(*arguments)
    found, _ = _poses(subject, "merged", settings, frames)
    np.testing.assert_allclose(found, expected, rtol=0, atol=POSES)
    found, _ = _poses(subject, "offline", OfflineSettings(), frames)
    np.testing.assert_allclose(found, plain, rtol=0, atol=POSES)
    assert (np.abs(expected - plain).max() > 1e-2) == (frames > 1)
