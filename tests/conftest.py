"""Scenes that many tests share. Nothing here turns double precision on: the library does that for itself."""

import os
import shutil
import tempfile

import pytest

# One cache of compiled code for one run of the tests: its workers, and the processes that tests start, find there what
# another has compiled. JAX reads these when it is imported, and children inherit them.
OWN_CACHE = "JAX_COMPILATION_CACHE_DIR" not in os.environ
if OWN_CACHE:
    os.environ["JAX_COMPILATION_CACHE_DIR"] = tempfile.mkdtemp(prefix="fivjax-tests-")
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.5"

import fivjax as fj  # noqa: E402


@pytest.fixture
def paper_scene() -> fj.Scene:
    """Section 4 of the paper: μ = 0.227, 3 m/s, a kick of 1.2."""
    return fj.Scene(fj.belt_oscillator(), fj.Coulomb(mu=0.227), belt_speed=3.0, load=fj.Pulse(force=100.0, p=1.2))


def pytest_unconfigure(config: pytest.Config) -> None:
    """The one who made the cache takes it away, when all workers are done."""
    if OWN_CACHE and not hasattr(config, "workerinput"):
        shutil.rmtree(os.environ["JAX_COMPILATION_CACHE_DIR"], ignore_errors=True)
