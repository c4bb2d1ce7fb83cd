"""Scenes that many tests share, and what they compile. Nothing here turns double precision on: the library does that for itself."""

import gc
import os
import shutil
import tempfile

import pytest

import fivjax as fj

CACHE = "JAX_COMPILATION_CACHE_DIR"

# Files that take longest. They come first: one of them begun last would leave the other workers idle.
LONGEST = (
    "energy maps gradients cycles several_contacts simulate cea steppers attractor verdicts returns_by_kernels notebooks "
    "tradeoff calibrate checkpoint properties reproduce types precision kernels basins branches"
)
LONGEST = {f"test_{name}.py": place for place, name in enumerate(LONGEST.split())}


def pytest_configure(config: pytest.Config) -> None:
    """Workers, and the processes that tests start, find compiled what one of them compiled.

    Most of the suite's time is compilation. Workers inherit the folder from the process that starts them, which removes it.
    """
    # What JAX traces is kept, so that looking for rubbish among it at JAX's pace takes a tenth of the time and finds little.
    gc.set_threshold(200_000, 20, 20)
    if CACHE not in os.environ:
        os.environ[CACHE] = config.stash[_FOLDER] = tempfile.mkdtemp(prefix="fivjax-compiled-")
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.1")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items.sort(key=lambda item: LONGEST.get(item.path.name, len(LONGEST)))


def pytest_unconfigure(config: pytest.Config) -> None:
    if (folder := config.stash.get(_FOLDER, None)) is not None:
        shutil.rmtree(folder, ignore_errors=True)


_FOLDER = pytest.StashKey[str]()


@pytest.fixture
def paper_scene() -> fj.Scene:
    """Section 4 of the paper: μ = 0.227, 3 m/s, a kick of 1.2."""
    return fj.Scene(fj.belt_oscillator(), fj.Coulomb(mu=0.227), belt_speed=3.0, load=fj.Pulse(force=100.0, p=1.2))


@pytest.fixture
def compilations() -> list[str]:
    """Has an entry for each program that is compiled from now on. JAX's listeners stay for as long as the process lives."""
    # Not above: JAX reads where to keep what is compiled when it is imported.
    import jax

    found: list[str] = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda event, duration, **about: found.append(event) if event.endswith("backend_compile_duration") else None
    )
    return found
