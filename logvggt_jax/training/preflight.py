"""What a run will need, tried in minutes before it is queued: devices, network, data, folder."""

from __future__ import annotations

import dataclasses
import functools
import math
import shutil
import time
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from logvggt_jax.compile import device_bytes
from logvggt_jax.data.dataset import Dataset
from logvggt_jax.data.feeding.batches import training_batches
from logvggt_jax.errors import InputError, one_line
from logvggt_jax.training.batches import open_sources
from logvggt_jax.training.checkpoint_files import Position
from logvggt_jax.training.checkpoints import RunCheckpoints
from logvggt_jax.training.config import SourceConfig, StageConfig, TrainConfig
from logvggt_jax.training.dry_run import step_costs
from logvggt_jax.training.optimizer import make_optimizer
from logvggt_jax.training.processes import any_process, check_shared
from logvggt_jax.training.program import abstract_parameters
from logvggt_jax.training.sharding import check_batch_size, replicated, split
from logvggt_jax.training.state import initial_state

_CLIPS = 20
_GIB = 2**30
