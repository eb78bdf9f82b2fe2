"""A model that compiles at once, clips with uneven masks, and the settings of a short run."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from logvggt_jax import ModelConfig, Predictions
from logvggt_jax.geometry import decode_poses, quaternion_to_matrix
from logvggt_jax.training.config import DataConfig, LossConfig, OptimizerConfig, SourceConfig, StageConfig, TrainConfig

ROOMS = (("height", 28), ("num_frames", 8), ("num_rooms", 8), ("width", 42))


@dataclasses.dataclass(frozen=True)
class PixelModel:
    """Depth from each pixel's colour, poses from each frame's mean colour; the interface of `LogVGGT`."""

    config: ModelConfig

    def apply(
        self, variables: Any, images: jax.Array, frame_mask: jax.Array | None = None, *, remat: bool = False
    ) -> Predictions:
        params = variables["params"]
        pixels = images.astype(jnp.float32) / 255.0
        dense = pixels @ params["depth_head"]["kernel"] + params["depth_head"]["bias"]
        poses = pixels.mean((2, 3)) @ params["camera_head"]["kernel"] + params["camera_head"]["bias"]
        rounds = jnp.stack([0.5 * poses, poses], axis=2)
        extrinsics, intrinsics = decode_poses(poses, images.shape[2:4])
        return Predictions(
            pose_encoding=poses,
            pose_encodings=rounds,
            extrinsics=extrinsics,
            intrinsics=intrinsics,
            depth=jnp.exp(dense[..., 0]),
            depth_confidence=1.0 + jnp.exp(dense[..., 1]),
            camera_tokens=poses,
            register_tokens=poses[:, :, None],
        )


@pytest.fixture(scope="session")
def pixel_model(small_config: ModelConfig) -> PixelModel:
    return PixelModel(small_config)


def pixel_parameters() -> dict[str, Any]:
    """Parameters of `PixelModel`."""
    generator = np.random.default_rng(1)

    def normal(*shape: int) -> np.ndarray:
        return (0.1 * generator.standard_normal(shape)).astype(np.float32)

    pose = np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.8, 1.0], np.float32)
    return {
        "encoder": {"kernel": normal(3, 3)},
        "camera_head": {"kernel": normal(3, 9), "bias": pose},
        "depth_head": {"kernel": normal(3, 2), "bias": normal(2)},
    }


def layered_parameters() -> dict[str, Any]:
    """Parameters of `parallel_runs.LayeredModel`: four layers, sixteen wide."""
    generator = np.random.default_rng(3)

    def normal(*shape: int) -> np.ndarray:
        return (0.2 * generator.standard_normal(shape)).astype(np.float32)

    blocks = {"kernel": normal(4, 16, 16), "bias": normal(4, 16)}
    return {**pixel_parameters(), "aggregator": {"embed": {"kernel": normal(3, 16)}, "frame_blocks": blocks}}


def use_model(loop: Any, model: Callable[[ModelConfig], Any], params: dict[str, Any]) -> None:
    """Gives a process's `training.loop` this model and its first parameters, whatever its settings say."""
    loop.LogVGGT = model
    loop.initial_parameters = lambda *_, **__: jax.tree.map(jnp.array, params)
    loop.abstract_parameters = lambda _: jax.eval_shape(lambda: params)


@pytest.fixture(scope="session")
def pixel_params() -> dict[str, Any]:
    return pixel_parameters()


@pytest.fixture(scope="session")
def layered(small_config: ModelConfig, pixel_model: PixelModel) -> Any:
    """A `parallel_runs.LayeredModel`; that file, which processes of their own run too, takes its model from here."""
    from parallel_runs import LayeredModel

    return LayeredModel(small_config, pixel_model)


@pytest.fixture(scope="session")
def layered_params() -> dict[str, Any]:
    return layered_parameters()


@pytest.fixture(scope="session")
def clips() -> dict[str, np.ndarray]:
    """Eight clips of five frames whose shares of valid pixels and lengths differ widely."""
    generator = np.random.default_rng(0)
    batch, frames, height, width = 8, 5, 28, 42
    quaternion = generator.normal(size=(batch, frames, 4)) + np.array([0.0, 0.0, 0.0, 4.0])
    extrinsics = np.zeros((batch, frames, 4, 4), np.float32)
    extrinsics[..., :3, :3] = quaternion_to_matrix(quaternion)
    extrinsics[..., :3, 3] = 0.3 * generator.normal(size=(batch, frames, 3))
    extrinsics[..., 3, 3] = 1.0
    depth = generator.uniform(1, 3, (batch, frames, height, width))
    shown = generator.uniform(size=depth.shape) < np.linspace(0.05, 1.0, batch)[:, None, None, None]
    intrinsics = np.array([[30.0, 0.0, width / 2], [0.0, 30.0, height / 2], [0.0, 0.0, 1.0]], np.float32)
    lengths = np.array([5, 1, 2, 5, 3, 4, 5, 2])
    return {
        "images": generator.integers(0, 256, (batch, frames, height, width, 3)).astype(np.uint8),
        "depth": np.where(shown, depth, 0.0).astype(np.float32),
        "intrinsics": np.tile(intrinsics, (batch, frames, 1, 1)),
        "extrinsics": extrinsics,
        "frame_mask": np.arange(frames) < lengths[:, None],
    }


@pytest.fixture(scope="session")
def loss_config() -> LossConfig:
    return LossConfig(
        name="log_vggt",
        camera_weight=1.0,
        depth_weight=1.0,
        translation_weight=1.0,
        rotation_weight=1.0,
        field_of_view_weight=0.5,
        gamma=0.6,
        alpha=0.2,
    )


@pytest.fixture(scope="session")
def optimizer_config() -> OptimizerConfig:
    return OptimizerConfig(
        learning_rate=1e-2,
        final_learning_rate=1e-4,
        schedule="cosine",
        warmup_fraction=0.25,
        restart_each_stage=False,
        b1=0.9,
        b2=0.99,
        weight_decay=0.1,
        decay_all=False,
        clip_norm=1.0,
    )


@pytest.fixture(scope="session")
def run_config(
    small_config: ModelConfig,
    loss_config: LossConfig,
    optimizer_config: OptimizerConfig,
    tmp_path_factory: pytest.TempPathFactory,
) -> TrainConfig:
    """Six steps on rooms: four of two frames, two of three. The rooms are rendered by the first run and kept: there
    are more than a hundred runs, and rendering took longer than all steps of one."""

    def stage(name: str, steps: int, clip_length: int) -> StageConfig:
        return StageConfig(
            name=name, steps=steps, clip_length=clip_length, batch_size=2, min_stride=1, max_stride=2, sizes=((28, 42),)
        )

    return TrainConfig(
        model=small_config,
        loss=loss_config,
        optimizer=optimizer_config,
        stages=(stage("first", 4, 2), stage("second", 2, 3)),
        data=DataConfig(
            sources=(SourceConfig(name="rooms", root=None, split="train", options=ROOMS),),
            reverse=0.5,
            worker_count=0,
            num_threads=0,
            cache_dir=str(tmp_path_factory.mktemp("rooms")),
        ),
        validation=None,
        seed=0,
        initial_weights=None,
        log_every=1,
        save_every=3,
        keep_checkpoints=2,
        max_skipped_in_a_row=2,
        max_minutes=None,
    )
