"""Scenes that many tests share. Nothing here turns double precision on: the library does that for itself."""

import os

import jax
import pytest

import fivjax as fj


def pytest_configure(config):
    """Most of the suite's time goes into compiling. What one worker, a process that a test starts, or the last run has
    compiled, the others read."""
    settings = {
        "jax_compilation_cache_dir": str(config.cache.mkdir("compiled")),
        "jax_persistent_cache_min_compile_time_secs": 0.2,
        # With a largest size, one process at a time reads and writes.
        "jax_compilation_cache_max_size": 2**30,
    }
    for name, value in settings.items():
        jax.config.update(name, value)
        os.environ[name.upper()] = str(value)


@pytest.fixture
def paper_scene() -> fj.Scene:
    """Section 4 of the paper: μ = 0.227, 3 m/s, a kick of 1.2."""
    return fj.Scene(fj.belt_oscillator(), fj.Coulomb(mu=0.227), belt_speed=3.0, load=fj.Pulse(force=100.0, p=1.2))
