"""`train.py` in processes of its own, with the model that compiles at once."""

import signal
import socket
import time
from pathlib import Path

from root_programs import RootPrograms

# Statements to run before the program.
PIXEL_MODEL = """
import sys
sys.path[:0] = ["tests/training", "."]
import conftest
from logvggt_jax.training import loop
conftest.use_model(loop, conftest.PixelModel, conftest.pixel_parameters())
"""
# Likewise, after those: with layers before it, large enough to be split over devices.
LAYERED_MODEL = """
from parallel_runs import LayeredModel
conftest.use_model(
    loop, lambda config: LayeredModel(config, conftest.PixelModel(config)), conftest.layered_parameters()
)
"""
# Likewise: no batch of this process can be read after so many examples, as where its readers are killed.
READERS_KILLED = """
from logvggt_jax.data.feeding import batches
read = batches.BatchIterator._read
def killed(stream):
    if stream.get_state()["examples"] == {}:
        raise batches.InputError("reading workers were killed")
    return read(stream)
batches.BatchIterator._read = killed
"""
# Flags of a run that does not end by itself; a test may add others, of which the last counts.
PIXEL_SETTINGS = (
    "--config=configs/tiny.py",
    "--config.stages.stage_1.steps=100000",
    "--config.stages.stage_1.batch_size=2",
    "--config.stages.stage_2.batch_size=2",
    # Each process renders its rooms, which otherwise takes as long as all else that it does.
    "--config.data.sources.rooms.options.num_rooms=2",
    "--config.data.sources.rooms.options.num_frames=24",
    "--config.validation.num_clips=2",
    "--config.validation.sources.rooms.options.num_rooms=2",
    "--config.validation.sources.rooms.options.num_frames=24",
    "--config.validation.every=100000",
    "--config.log_every=10",
    "--config.save_every=100000",
)


class PixelRuns:
    """Two processes of `train.py` with the model that compiles at once; ended when the block is left.

    `patches` are Python statements for each process, run before training; `own` are flags of each beside the `flags`.
    """

    def __init__(
        self,
        programs: RootPrograms,
        *workdirs: Path,
        patches: tuple[str, str] = ("", ""),
        flags: tuple[str, ...] = (),
        own: tuple[tuple[str, ...], tuple[str, ...]] = ((), ()),
    ) -> None:
        address = f"localhost:{free_port()}"
        self.processes = [
            programs.start(
                "train.py",
                *PIXEL_SETTINGS,
                f"--workdir={workdir}",
                "--distributed",
                f"--coordinator={address}",
                "--num_processes=2",
                f"--process_id={number}",
                *flags,
                *own[number],
                first=f"{PIXEL_MODEL}\n{patch}",
            )
            for number, (workdir, patch) in enumerate(zip(workdirs, patches, strict=True))
        ]

    def __enter__(self) -> "PixelRuns":
        return self

    def __exit__(self, *_: object) -> None:
        for process in self.processes:
            process.send_signal(signal.SIGKILL)
            process.wait()

    def training(self) -> None:
        """Waits for a line of a step after the first."""
        output, end = self.processes[0].output, time.monotonic() + 600
        while not (output.exists() and "\nstep 10/" in output.read_text()):
            assert time.monotonic() < end, self.processes[0].error.read_text()
            time.sleep(0.05)

    def errors(self, process: int) -> str:
        """What a process said on standard error until its end, without what the libraries say at the start."""
        self.processes[process].wait()
        lines = self.processes[process].error.read_text().splitlines(keepends=True)
        return "".join(line for line in lines if not line.startswith(("[Gloo]", "rendering rooms")))


def free_port() -> int:
    """A port of this machine that nobody listens at."""
    with socket.socket() as probe:
        probe.bind(("localhost", 0))
        return int(probe.getsockname()[1])
