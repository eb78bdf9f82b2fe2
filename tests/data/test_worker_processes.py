"""Workers end with the process that they work for, however that ends."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

# Kills itself once a worker of its own waits for more to do.
IDLE = """
import os, signal
from logvggt_jax.data.worker_processes import worker_pool
with worker_pool(1) as pool:
    assert pool.submit(os.getpid).result() != os.getpid()
    os.kill(os.getpid(), signal.SIGKILL)
"""
# Likewise, with a worker that waits for room for the clips that it has read.
READING = """
import os, signal
from logvggt_jax.data.feeding.batches import training_batches
from logvggt_jax.data.rooms.rooms import Rooms
rooms = Rooms("train", height=14, width=14, num_frames=4, num_rooms=4)
options = {"clip_length": 2, "batch_size": 1, "sizes": [(14, 14)], "seed": 0, "num_threads": 0}
with training_batches({"rooms": rooms}, **options, worker_count=1) as batches:
    next(batches)
    os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.parametrize("script", [IDLE, READING], ids=["idle", "reading"])
def test_no_worker_outlives_a_killed_process(script: str) -> None:
    # Whoever is left holds the pipe open.
    killed = subprocess.run(
        [sys.executable, "-c", script], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=60
    )
    assert killed.returncode == -9, killed.stdout
