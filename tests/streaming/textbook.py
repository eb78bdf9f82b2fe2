"""VGGT's trunk and camera head written out in numpy, float64 and one token list at a time, with the memories of the
frame-by-frame methods as plain lists: an account of the methods that shares no line with the package's.

Of the package come the parameters, and the patch tokens of the encoder, on which the methods do not differ.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from logvggt_jax import ModelConfig

Attend = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
"""Queries, keys and values [N, heads, head_dim] of a block's own tokens to what they take in."""


def layer_norm(x: np.ndarray, params: Any, epsilon: float = 1e-5) -> np.ndarray:
    normed = (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + epsilon)
    return normed if params is None else normed * params["scale"] + params["bias"]


def linear(x: np.ndarray, params: Any) -> np.ndarray:
    return x @ np.asarray(params["kernel"], np.float64) + params["bias"]


def gelu(x: np.ndarray) -> np.ndarray:
    return x * 0.5 * (1 + np.vectorize(math.erf)(x / math.sqrt(2)))


def mlp(x: np.ndarray, params: Any) -> np.ndarray:
    return linear(gelu(linear(x, params["fc1"])), params["fc2"])


def softmax(x: np.ndarray) -> np.ndarray:
    weights = np.exp(x - x.max(-1, keepdims=True))
    return weights / weights.sum(-1, keepdims=True)


def attended(query: np.ndarray, key: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Every query [N, heads, head_dim] sees every key [M, heads, head_dim] of its head."""
    weights = softmax(np.einsum("nhd,mhd->hnm", query, key) / math.sqrt(query.shape[-1]))
    return np.einsum("hnm,mhd->nhd", weights, value)


def rotated(x: np.ndarray, positions: np.ndarray, base: float) -> np.ndarray:
    """The first half of a head's channels is turned by the row, the second by the column; of a half the first and the
    second part are the coordinates that are turned together."""
    halves = []
    for axis, half in enumerate(np.split(x, 2, axis=-1)):
        first, second = np.split(half, 2, axis=-1)
        quarter = first.shape[-1]
        angle = positions[:, axis, None, None] / base ** (np.arange(quarter) / quarter)
        halves += [first * np.cos(angle) - second * np.sin(angle), second * np.cos(angle) + first * np.sin(angle)]
    return np.concatenate(halves, axis=-1)


def block(
    x: np.ndarray, params: Any, heads: int, attend: Attend, rotate: Callable[[np.ndarray], np.ndarray] | None = None
) -> np.ndarray:
    """A pre-norm block of tokens [N, C]; with `rotate` queries and keys are normalised, and then turned."""
    attention = params["attention"]
    normed = layer_norm(x, params["norm1"])
    query = linear(normed, attention["query"])
    key, value = np.split(linear(normed, attention["key_value"]), 2, axis=-1)
    query, key, value = (each.reshape(len(x), heads, -1) for each in (query, key, value))
    if rotate is not None:
        query = rotate(layer_norm(query, attention["query_norm"]))
        key = rotate(layer_norm(key, attention["key_norm"]))
    x = x + params["scale1"]["gamma"] * linear(attend(query, key, value).reshape(x.shape), attention["output"])
    return x + params["scale2"]["gamma"] * mlp(layer_norm(x, params["norm2"]), params["mlp"])


class Everything:
    """Keys and values of all frames (StreamVGGT), a list of frames."""

    def __init__(self) -> None:
        self.frames: list[tuple[np.ndarray, np.ndarray]] = []

    def __call__(self, query: np.ndarray, key: np.ndarray, value: np.ndarray) -> np.ndarray:
        self.frames.append((key, value))
        return attended(query, *(np.concatenate(each) for each in zip(*self.seen(), strict=True)))

    def seen(self) -> list[tuple[np.ndarray, np.ndarray]]:
        return self.frames


class FirstAndNewest(Everything):
    """The first frame and the newest `window`, the frame itself among them (STream3R)."""

    def __init__(self, window: int) -> None:
        super().__init__()
        self.window = window

    def seen(self) -> list[tuple[np.ndarray, np.ndarray]]:
        return [each for i, each in enumerate(self.frames) if i == 0 or i > len(self.frames) - 1 - self.window]


class Rolling:
    """One layer's cache within a budget (InfiniteVGGT), for every head a list of (key, value).

    `gap` is how far apart in score the last token that ever stayed and the first that went were, the least of all.
    """

    def __init__(self, anchor_frames: int) -> None:
        self.anchor_frames, self.budget, self.score, self.gap = anchor_frames, 0, 0.0, math.inf
        self.heads: list[list[tuple[np.ndarray, np.ndarray]]] = []

    def __call__(self, query: np.ndarray, key: np.ndarray, value: np.ndarray) -> np.ndarray:
        tokens, heads, _ = key.shape
        self.heads = self.heads or [[] for _ in range(heads)]
        for head in range(heads):
            self.heads[head] += list(zip(key[:, head], value[:, head], strict=True))
        anchor = self.anchor_frames * tokens
        if len(self.heads[0]) > self.budget:
            means = []
            for head, held in enumerate(self.heads):
                keys = np.array([k for k, _ in held[anchor:]])
                unit = keys / np.linalg.norm(keys, axis=1, keepdims=True)
                scores = unit @ unit.mean(0)
                means.append(scores.mean())
                ranked, stay = np.argsort(scores, kind="stable"), self.budget - anchor
                if 0 < stay < len(scores):
                    self.gap = min(self.gap, scores[ranked[stay]] - scores[ranked[stay - 1]])
                self.heads[head] = held[:anchor] + [held[anchor + i] for i in sorted(ranked[:stay])]
            self.score = float(np.mean(means))
        taken = []
        for head, held in enumerate(self.heads):
            keys, values = (np.array(each)[:, None] for each in zip(*held, strict=True))
            taken.append(attended(query[:, head, None], keys, values))
        return np.concatenate(taken, axis=1)


class Pruned:
    """One layer's cache of which the newest queries choose (XStreamVGGT), a list of (key, value) of all heads.

    `special` tokens of a frame are queries of their own, its other ones count in runs of 16. With `codes` all that is
    kept is rounded to 4 bits over again with every frame, before it is pruned. `gap` as of `Rolling`.
    """

    def __init__(self, cap: int, special: int, *, codes: bool = False) -> None:
        self.cap, self.special, self.codes, self.gap = cap, special, codes, math.inf
        self.held: list[tuple[np.ndarray, np.ndarray]] = []

    def __call__(self, query: np.ndarray, key: np.ndarray, value: np.ndarray) -> np.ndarray:
        tokens = len(query)
        self.held += list(zip(key, value, strict=True))
        keys, values = (np.array(each) for each in zip(*self.held, strict=True))
        if self.codes:
            self.held = list(zip(*_in_4_bits(keys, values), strict=True))
        if len(self.held) > max(self.cap, 2 * tokens):
            patches = query[self.special :]
            runs = [patches[i : i + 16].mean(0) for i in range(0, len(patches), 16)]
            proxies = np.array([*query[: self.special], *runs]).mean(1)
            middle = range(tokens, len(self.held) - tokens)
            scores = {i: float(np.mean(proxies @ self.held[i][0].mean(0))) for i in middle}
            ranked, room = sorted(middle, key=lambda i: -scores[i]), max(0, self.cap - 2 * tokens)
            if 0 < room < len(ranked):
                self.gap = min(self.gap, scores[ranked[room - 1]] - scores[ranked[room]])
            kept = {*range(tokens), *ranked[:room], *range(len(self.held) - tokens, len(self.held))}
            self.held = [self.held[i] for i in sorted(kept)]
        return attended(query, keys, values)


def _in_4_bits(keys: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What 4 bits leave of keys [N, heads, head_dim], in groups of 64 tokens filled up with zeros, and of values."""

    def rounded(x: np.ndarray, axis: int) -> np.ndarray:
        x = x.astype(np.float32)
        low, high = x.min(axis, keepdims=True), x.max(axis, keepdims=True)
        scale = np.maximum((high - low) / np.float32(15), np.float32(1e-12))
        zero = np.clip(np.round(-low / scale), 0, 15)
        return (np.clip(np.round(x / scale) + zero, 0, 15) - zero) * scale

    groups = -(-len(keys) // 64)
    filled = np.concatenate([keys, np.zeros((64 * groups - len(keys), *keys.shape[1:]))])
    filled = rounded(filled.reshape(groups, 64, *keys.shape[1:]), 1).reshape(filled.shape)
    return filled[: len(keys)], rounded(values, -1)


class Network:
    """The network frame by frame.

    Args:
      config: of the model.
      params: its parameters.
      grid: (h, w) patches of a frame.
      layers: a memory for each global block.
      trunk: makes the memory of a block of the camera head's trunk.
      registers: which frames' registers a camera token reads at frame t, itself among them.
      single: one memory a block of the trunk for all rounds, where each round has its own else.
    """

    def __init__(
        self,
        config: ModelConfig,
        params: Any,
        grid: tuple[int, int],
        *,
        layers: list[Any],
        trunk: Callable[[], Any],
        registers: Callable[[int], list[int]],
        single: bool = False,
    ) -> None:
        self.config, self.params, self.layers, self.registers = config, params, layers, registers
        head = config.camera_head
        caches = [[trunk() for _ in range(head.depth)] for _ in range(1 if single else head.iterations)]
        self.trunk = caches * head.iterations if single else caches
        special = 1 + config.aggregator.num_registers
        self.special, rows = special, np.indices(grid).reshape(2, -1).T + 1
        self.positions = np.concatenate([np.zeros((special, 2)), rows])
        self.register_tokens: list[np.ndarray] = []

    def frame(self, patches: np.ndarray) -> np.ndarray:
        """The pose encoding [9] of the next frame, of its patch tokens [h · w, C]."""
        aggregator, sizes, t = self.params["aggregator"], self.config.aggregator, len(self.register_tokens)
        copy = min(t, 1)
        x = np.concatenate([aggregator["camera_token"][0, copy], aggregator["register_token"][0, copy], patches])

        def rotate(heads: np.ndarray) -> np.ndarray:
            return rotated(heads, self.positions, sizes.rope_base)

        for layer in range(sizes.depth):
            own = block(x, aggregator[f"frame_block_{layer}"], sizes.num_heads, attended, rotate)
            x = block(own, aggregator[f"global_block_{layer}"], sizes.num_heads, self.layers[layer], rotate)
        tokens = np.concatenate([own, x], axis=-1)[: self.special]
        self.register_tokens.append(tokens[1:])
        return self.poses(self.refined(tokens[:1], t))[0]

    def refined(self, camera: np.ndarray, t: int) -> np.ndarray:
        """Camera tokens [N, 2C] after GCCR at frame t."""
        settings = self.config.refinement
        if not settings.enabled:
            return camera
        gccr = self.params["gccr"]
        read = np.concatenate([self.register_tokens[i] for i in self.registers(t)])
        read = layer_norm(read, gccr["register_norm"])
        query = linear(layer_norm(camera, gccr["camera_norm"]), gccr["query"])
        parts = (query, linear(read, gccr["key"]), linear(read, gccr["value"]))
        taken = attended(*(each.reshape(len(each), settings.num_heads, -1) for each in parts))
        return camera + linear(taken.reshape(camera.shape), gccr["output"])

    def poses(self, camera: np.ndarray) -> np.ndarray:
        """Pose encodings [N, 9] of refined camera tokens [N, 2C]."""
        head, sizes = self.params["camera_head"], self.config.camera_head
        tokens = layer_norm(camera, head["token_norm"])
        plain = layer_norm(tokens, None, 1e-6)
        pose, embedded = np.array(sizes.initial_pose), np.asarray(head["empty_pose_tokens"], np.float64)[0, 0]
        for memories in self.trunk:
            features = linear(embedded, head["embed_pose"])
            features = features / (1 + np.exp(-features))
            shift, scale, gate = np.split(linear(features, head["modulation"]), 3, axis=-1)
            z = gate * (plain * (1 + scale) + shift) + tokens
            for i, memory in enumerate(memories):
                z = block(z, head[f"trunk_{i}"], sizes.num_heads, memory)
            pose = pose + mlp(layer_norm(z, head["trunk_norm"]), head["pose_branch"])
            embedded = pose
        return np.concatenate([pose[:, :7], np.maximum(pose[:, 7:], 0)], axis=1)


def budgets(scores: list[float], total: int, temperature: float) -> list[int]:
    """Tokens a head of each layer."""
    return [int(share * total) for share in softmax((1 - np.array(scores)) / temperature)]


def offline(
    config: ModelConfig,
    params: Any,
    grid: tuple[int, int],
    patches: np.ndarray,
    merging: tuple[np.ndarray, np.ndarray, np.ndarray, int] | None = None,
) -> np.ndarray:
    """Pose encodings [T, 9] of plain VGGT, where every frame of patch tokens [T, h · w, C] sees every other.

    `merging` are FastVGGT's tokens that may be merged, those that they may be merged into, those that also attend on
    their own, and how many are merged, the most similar first.
    """
    network = Network(config, params, grid, layers=[], trunk=lambda: attended, registers=lambda t: [])
    aggregator, sizes, frames = params["aggregator"], config.aggregator, len(patches)
    special = [
        np.concatenate([aggregator[f"{kind}_token"][0, min(t, 1)] for kind in ("camera", "register")])
        for t in range(frames)
    ]
    x = np.concatenate([np.stack(special), patches], axis=1)
    shape = x.shape

    def rotate(heads: np.ndarray) -> np.ndarray:
        return rotated(heads, np.tile(network.positions, (len(heads) // shape[1], 1)), sizes.rope_base)

    for layer in range(sizes.depth):
        of_frames, of_all = (aggregator[f"{kind}_block_{layer}"] for kind in ("frame", "global"))
        own = np.stack([block(frame, of_frames, sizes.num_heads, attended, rotate) for frame in x])
        rows = own.reshape(-1, shape[-1])
        attend = attended if merging is None else _merged(layer_norm(rows, of_all["norm1"]), *merging)
        x = block(rows, of_all, sizes.num_heads, attend, rotate).reshape(shape)
    tokens = np.concatenate([own, x], axis=-1)[:, : network.special]
    network.register_tokens, network.registers = list(tokens[:, 1:]), lambda t: list(range(frames))
    return network.poses(network.refined(tokens[:, 0], frames))


def _merged(features: np.ndarray, sources: np.ndarray, targets: np.ndarray, protected: np.ndarray, most: int) -> Attend:
    """Attention of tokens of which some are merged, by the cosine of their features [N, C]."""
    unit = features / np.linalg.norm(features, axis=1, keepdims=True)
    cosine = unit[sources] @ unit[targets].T
    best, order = cosine.argmax(1), np.argsort(-cosine.max(1), kind="stable")
    merged, alone = order[:most], order[most:]

    def attend(query: np.ndarray, key: np.ndarray, value: np.ndarray) -> np.ndarray:
        def rows(x: np.ndarray) -> np.ndarray:
            groups = [[target, *sources[merged[best[merged] == i]]] for i, target in enumerate(targets)]
            return np.concatenate([x[sources[alone]], [x[group].mean(0) for group in groups], x[protected]])

        found, out = attended(rows(query), rows(key), rows(value)), np.empty_like(query)
        of_targets = found[len(alone) : len(alone) + len(targets)]
        out[sources[alone]], out[targets], out[sources[merged]] = (
            found[: len(alone)],
            of_targets,
            of_targets[best[merged]],
        )
        out[protected] = found[len(alone) + len(targets) :]
        return out

    return attend
