"""Shared fixtures: a small model, and the reference data that lie beside the repository where they exist."""

import ctypes
import gc
import inspect
import multiprocessing
import os
import pickle
import resource
import shutil
import sys
import time
from collections.abc import Iterator
from multiprocessing import forkserver
from pathlib import Path

import jax
import numpy as np
import pytest
from absl import flags

# Before any computation: sharded code is tested on sixteen devices, and as most of a test's time is compilation, the
# code generator optimises little, in one piece, and what would only make programs faster is left out. Older releases
# also have simpler emitters, which halve that time.
LEFT_OUT = (
    "cpu-parallel-task-assigner",
    "simplify-while-loops",
    "transpose-folding",
    "tree_reduction_rewriter",
    "while-loop-constant-sinking",
    "while-loop-invariant-code-motion",
)
SIMPLE = " --xla_cpu_use_fusion_emitters=false" if jax.__version_info__ < (0, 11) else ""
QUICK = (
    "--xla_backend_optimization_level=0 --xla_cpu_parallel_codegen_split_count=1 "
    f"--xla_cpu_opt_preset=CPU_OPT_PRESET_FAST_COMPILE --xla_disable_hlo_passes={','.join(LEFT_OUT)}"
)
os.environ.setdefault("XLA_FLAGS", QUICK + SIMPLE)
# Programs do not say from which lines they were traced, which would take a few hundredths of the time; nor do those of
# the processes that tests start.
os.environ["JAX_TRACEBACK_IN_LOCATIONS_LIMIT"] = "0"
jax.config.update("jax_traceback_in_locations_limit", 0)
jax.config.update("jax_platforms", "cpu")
jax.config.update("jax_num_cpu_devices", 16)

from root_programs import RootPrograms, loaded  # noqa: E402

from logvggt_jax import LogVGGT, ModelConfig  # noqa: E402
from logvggt_jax.doctor.subject import tiny_config  # noqa: E402

# Tracing makes many objects and little garbage: by default the collector takes an eighth of a tracer's time.
gc.set_threshold(100_000, 50, 100)

# Grain reads absl flags, which only `app.run` parses.
if not flags.FLAGS.is_parsed():
    flags.FLAGS.mark_as_parsed()

# Files of more than about fifteen seconds of processor time, the dearest first: none is left to one process at the end.
DEAREST = (
    # Waits for a process of its own.
    "training/test_train_script.py",
    # Holds the most memory of all: it begins where there is nothing yet.
    "training/parallel/test_sharding.py",
    "model/test_logvggt.py",
    "streaming/test_frame_methods.py",
    "training/test_loop.py",
    "weights/test_checkpoints.py",
    "model/test_windows.py",
    "doctor/test_doctor.py",
    "model/test_parity.py",
    "streaming/test_snapshot.py",
    "test_configs.py",
    "test_cli.py",
    "streaming/test_stream_session.py",
    "model/test_golden_pruned.py",
    "model/test_refinement.py",
    "streaming/test_bounded_stream.py",
    "evaluation/costs/test_throughput.py",
    "evaluation/test_eval_script.py",
    "training/parallel/test_processes.py",
    "weights/test_vggt.py",
    "evaluation/test_run.py",
)

# What processes that tests spawn import, see `forked_workers`.
SPAWNED = ("data.feeding.batches", "data.registry", "evaluation.records", "reconstruction.result")

# Bytes of a test process at its peak: laptops of 8 GB run two.
MOST_MEMORY = 2_500_000_000
# Bytes held after a file at which what is compiled is dropped; dropping it after every file took half a minute.
MUCH_MEMORY = 1_500_000_000
# Bytes that have to be free for temporary files, three times what a whole run writes.
LEAST_ROOM = 2_000_000_000
SHARED = Path(os.environ.get("LOGVGGT_SHARED", Path(__file__).parents[2] / "shared"))


def pytest_configure() -> None:
    """Temporary files lie in memory where there is enough of it and programs may run from there, unless the user has
    said where they belong: hundreds of small checkpoints would wait for a disk longer than they compute."""
    memory = Path("/dev/shm")
    if "TMPDIR" not in os.environ and memory.is_dir() and os.access(memory, os.W_OK):
        room, runs_programs = shutil.disk_usage(memory).free, not os.statvfs(memory).f_flag & os.ST_NOEXEC
        if room > LEAST_ROOM and _free_memory() > LEAST_ROOM + 2 * MOST_MEMORY and runs_programs:
            os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", str(memory))


def _free_memory() -> int:
    """Bytes that this machine's programs can still have."""
    kilobytes = dict(line.split(":") for line in Path("/proc/meminfo").read_text().splitlines())
    return 1024 * int(kilobytes["MemAvailable"].split()[0])


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    place = {Path(__file__).parent / name: number for number, name in enumerate(DEAREST)}
    items.sort(key=lambda item: place.get(item.path, len(place)))


def pytest_collection_finish() -> None:
    """The modules imported by now stay: no later collection walks through their third of a million objects again."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True, scope="session")
def _own_user_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Nothing that a test keeps lands in the developer's own cache."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(autouse=True, scope="session")
def _programs_are_compiled_once(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """What one test compiled, another one, the other workers and the processes that tests start only read."""
    own = tmp_path_factory.getbasetemp()
    shared = own.parent if "PYTEST_XDIST_WORKER" in os.environ else own
    settings = {
        "jax_compilation_cache_dir": str(shared / "programs"),
        "jax_persistent_cache_min_compile_time_secs": 0.0,
        "jax_persistent_cache_min_entry_size_bytes": -1,
    }
    with pytest.MonkeyPatch.context() as patch:
        for name, value in settings.items():
            jax.config.update(name, value)
            patch.setenv(name.upper(), str(value))
        yield


@pytest.fixture(scope="session")
def programs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RootPrograms]:
    """`train.py` and `eval.py` on the CPU, their libraries imported once for all tests of this process."""
    libraries = ("evaluation.run", "training.loop", "training.dry_run", "training.preflight")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("JAX_PLATFORMS", "cpu")
        folder = tmp_path_factory.mktemp("programs")
        with loaded(folder, "pytest", *(f"logvggt_jax.{name}" for name in libraries)) as programs:
            patch.undo()
            yield programs


@pytest.fixture(scope="session")
def _imported_once() -> Iterator[None]:
    """The interpreter that `forked_workers` forks, started by the first of them."""
    multiprocessing.set_forkserver_preload(["pytest", *(f"logvggt_jax.{name}" for name in SPAWNED)])
    yield
    forkserver._forkserver._stop()


@pytest.fixture
def forked_workers(_imported_once: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Processes that would be spawned are forks of one interpreter that has imported their libraries. They get what
    they work on as spawned ones do, pickled; what takes each of those more than a second is imported once."""
    if "forkserver" in multiprocessing.get_all_start_methods():
        context = multiprocessing.get_context("forkserver")

        def forked(method: str) -> multiprocessing.context.BaseContext:
            assert method == "spawn", "a fork of a process that runs JAX can deadlock"
            return context

        monkeypatch.setattr(multiprocessing, "get_context", forked)


@pytest.fixture(autouse=True, scope="module")
def _memory_stays_small(request: pytest.FixtureRequest) -> Iterator[None]:
    """What one file compiled serves the next, until much memory is held: a quick worker stays below 2.5 GB."""
    yield
    if sys.platform != "linux":
        jax.clear_caches()
        return
    if _resident_memory() > MUCH_MEMORY:
        jax.clear_caches()
        gc.collect()
        ctypes.CDLL(None).malloc_trim(0)
    peak = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert request.config.option.markexpr != "not slow" or peak < MOST_MEMORY, f"{peak / 1e9:.2f} GB at most so far"


def _resident_memory() -> int:
    """Bytes that this process holds now."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize()


@pytest.fixture
def abandoned_reads(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """For tests that damage what Orbax reads: when one read fails it drops the others, and each complains of that
    whenever it ends. They end here, not in the middle of a later test."""
    monkeypatch.setattr(sys, "unraisablehook", lambda _: None)
    # What was there before is not walked through again and again; nor is it listed by `gc.get_objects`.
    gc.collect()
    gc.freeze()
    yield
    end = time.monotonic() + 10
    gc.collect()
    while _reads_are_alive() and time.monotonic() < end:
        time.sleep(0.05)
        gc.collect()


def _reads_are_alive() -> bool:
    coroutines = (each for each in gc.get_objects() if inspect.iscoroutine(each))
    return any("orbax" in coroutine.cr_code.co_filename for coroutine in coroutines)


def _shared(*parts: str) -> Path:
    path = SHARED.joinpath(*parts)
    if not path.exists():
        pytest.skip(f"reference data {'/'.join(parts)} not found in {SHARED} (set LOGVGGT_SHARED)")
    return path


@pytest.fixture(scope="session")
def golden_dir() -> Path:
    """Outputs of the original VGGT and of the reference metrics."""
    return _shared("golden")


@pytest.fixture(scope="session")
def seven_scenes_dir() -> Path:
    """1,000 real RGB-D frames with poses in the official 7-Scenes layout."""
    return _shared("data", "7scenes")


@pytest.fixture(scope="session")
def examples_dir() -> Path:
    """Photographs and a video without ground truth."""
    return _shared("data", "examples")


@pytest.fixture(scope="session")
def cases_dir() -> Path:
    """Small pictures, videos and folders as users have them."""
    return _shared("data", "cases")


@pytest.fixture(scope="session")
def small_config() -> ModelConfig:
    """A model of about 0.2 M parameters that has every part; images of 28 x 42 give it 2 x 3 patches."""
    return tiny_config()


@pytest.fixture(scope="session")
def small_variables(small_config: ModelConfig, tmp_path_factory: pytest.TempPathFactory) -> dict:
    """Parameters of the small model, all of them moved off their initial value: no gate is zero."""
    # Drawing them takes seconds, which one test process of several spends for all.
    drawn = tmp_path_factory.getbasetemp().parent / "small_variables.pickle"
    if "PYTEST_XDIST_WORKER" in os.environ and drawn.exists():
        return pickle.loads(drawn.read_bytes())
    images = np.zeros((1, 1, 28, 42, 3), np.float32)
    variables = LogVGGT(small_config).init(jax.random.key(0), images)
    generator = np.random.default_rng(0)
    moved = jax.tree.map(
        lambda x: x + 0.1 * generator.standard_normal(x.shape).astype(np.float32), jax.device_get(variables)
    )
    if "PYTEST_XDIST_WORKER" in os.environ:
        own = drawn.with_suffix(f".{os.getpid()}")
        own.write_bytes(pickle.dumps(moved))
        own.replace(drawn)
    return moved
