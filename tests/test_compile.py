"""Devices that were asked for and are not there, and those that lie idle."""

from __future__ import annotations

import jax
import pytest

from logvggt_jax import compile as module
from logvggt_jax.errors import InputError


def test_a_platform_that_does_not_start_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse() -> str:
        raise AssertionError

    monkeypatch.setattr(jax, "default_backend", refuse)
    with pytest.raises(InputError, match=r"do not start \(AssertionError\).*logvggt-jax\[cuda\].*unset JAX_PLATFORMS"):
        module.check_devices()


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
