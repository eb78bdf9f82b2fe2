"""Devices that were asked for and are not there, and those that lie idle."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from unittest import mock

import jax
import pytest
from root_programs import RootPrograms

from logvggt_jax import compile as module
from logvggt_jax.errors import InputError

ROOT = Path(__file__).parents[1]


def test_a_platform_that_does_not_start_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse() -> str:
        raise AssertionError

    def message() -> str:
        with pytest.raises(InputError, match=r"do not start \(AssertionError\).*unset JAX_PLATFORMS$") as refused:
            module.check_devices()
        return str(refused.value)

    monkeypatch.setattr(jax, "default_backend", refuse)
    monkeypatch.setattr(module, "nvidia_gpu_present", lambda: False)
    monkeypatch.setattr(module, "installed_packages", lambda: {"jax": "0.11.2", "jax-cuda13-plugin": "0.11.2"})
    assert "pip install" in message(), "of other devices"
    platforms = jax.config.jax_platforms
    jax.config.update("jax_platforms", "cuda")
    try:
        assert "see that nvidia-smi lists one" in message()
        monkeypatch.setattr(module, "installed_packages", lambda: {"jax": "0.11.2"})
        assert "logvggt-jax[cuda]" in message()
    finally:
        jax.config.update("jax_platforms", platforms)


def test_programs_are_counted_as_they_are_made() -> None:
    double = jax.jit(lambda x: 2 * x)
    number = jax.numpy.ones(3)
    with module.counted_compilations() as compilations:
        double(number)
        first = compilations.count
        double(number)
        assert compilations.count == first > 0
    double(jax.numpy.ones(4))
    assert compilations.count == first, "what came after is not counted"


def test_options_for_gpus_are_those_that_this_xla_knows(monkeypatch: pytest.MonkeyPatch) -> None:
    device = jax.devices()[0]
    assert module.quick_compilation(device) == {}, "a CPU's programs compile as they do"
    monkeypatch.setattr(module, "_QUICK", {"xla_gpu_enable_triton_gemm": False, "xla_gpu_no_such_option": True})
    assert [module._accepted(device, *option) for option in module._QUICK.items()] == [True, False]
    gpu = mock.Mock(platform="gpu")
    monkeypatch.setattr(module, "_accepted", lambda device, name, value: device is gpu and "no_such" not in name)
    assert module.quick_compilation(gpu) == {"xla_gpu_enable_triton_gemm": False}


@pytest.mark.parametrize(("asked", "refused"), [(None, True), ("cuda,cpu", True), ("cpu", False)])
def test_two_builds_of_nccl_are_refused(monkeypatch: pytest.MonkeyPatch, asked: str | None, refused: bool) -> None:
    names = {"nvidia-nccl-cu12": "2", "nvidia-nccl-cu13": "2", "nvidia-cudnn-cu13": "9"}
    monkeypatch.setattr(module, "nvidia_gpu_present", lambda: True)
    monkeypatch.setattr(module, "installed_packages", lambda: names)
    monkeypatch.setattr(type(jax.config), "jax_platforms", asked, raising=False)
    if refused:
        with pytest.raises(InputError, match=r"nvidia-nccl-cu12 and nvidia-nccl-cu13 are both installed, .*uninstall"):
            module.check_nccl()
    del names["nvidia-nccl-cu12" if refused else "nvidia-cudnn-cu13"]
    module.check_nccl()


@pytest.mark.parametrize(("asked", "warned"), [(None, True), ("cpu", False)])
def test_an_idle_gpu_draws_a_warning(monkeypatch: pytest.MonkeyPatch, asked: str | None, warned: bool) -> None:
    monkeypatch.setattr(module, "nvidia_gpu_present", lambda: True)
    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    monkeypatch.setattr(type(jax.config), "jax_platforms", asked, raising=False)
    if warned:
        with pytest.warns(UserWarning, match="this machine has an NVIDIA GPU"):
            module.check_devices()
    else:
        module.check_devices()


def test_the_command_says_that_devices_do_not_start(tmp_path: Path) -> None:
    # Nowhere is a device of this kind, whatever the machine has.
    environment = {**os.environ, "JAX_PLATFORMS": "rocm"}
    command = [sys.executable, "-m", "logvggt_jax", "convert", "nowhere", "--output", str(tmp_path / "out")]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False, timeout=300)
    _is_one_line(done, tmp_path / "out")


@pytest.mark.parametrize(
    "arguments",
    [
        ["train.py", "--config=configs/tiny.py", "--workdir=OUT"],
        ["eval.py", "--config=configs/eval/rooms.py", "--checkpoint=nowhere", "--output=OUT"],
    ],
    ids=["train.py", "eval.py"],
)
def test_root_programs_say_that_devices_do_not_start(
    arguments: list[str], programs: RootPrograms, tmp_path: Path
) -> None:
    # JAX is imported by then, and reads the variable as it is imported.
    first = "import os, jax\nos.environ['JAX_PLATFORMS'] = 'rocm'\njax.config.update('jax_platforms', 'rocm')"
    done = programs(*(argument.replace("OUT", str(tmp_path / "out")) for argument in arguments), first=first)
    _is_one_line(done, tmp_path / "out")


def _is_one_line(done: subprocess.CompletedProcess[str], output: Path) -> None:
    """The program said of this platform what is to be said, and wrote nothing."""
    assert done.returncode != 0
    assert "JAX_PLATFORMS=rocm" in done.stderr
    assert "Traceback" not in done.stderr
    assert not output.exists()


def test_a_user_without_a_home_has_no_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    def nobody(self: Path) -> Path:
        raise RuntimeError("Could not determine home directory.")

    for name in ("XDG_CACHE_HOME", "JAX_COMPILATION_CACHE_DIR"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(Path, "expanduser", nobody)
    before = jax.config.jax_enable_compilation_cache
    try:
        assert module.enable_compilation_cache() is None
    finally:
        jax.config.update("jax_enable_compilation_cache", before)


def test_an_empty_variable_is_no_folder_for_the_cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    before = jax.config.jax_compilation_cache_dir
    try:
        assert module.enable_compilation_cache() == tmp_path / "logvggt" / "xla"
    finally:
        jax.config.update("jax_compilation_cache_dir", before)


def test_a_cache_that_is_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "cache").touch()
    with pytest.raises(InputError, match=r"cache is no folder: give another --compilation_cache"):
        module.enable_compilation_cache(str(tmp_path / "cache"))
