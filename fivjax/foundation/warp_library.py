"""NVIDIA Warp, where it is installed: kernels of one thread for each trajectory, on a CPU or on GPUs.

It comes with fivjax where it has wheels. It is imported only where it is used, because that takes a third of a second.
"""

import contextlib
import ctypes.util
import functools
import importlib.util
import os
import tempfile
import threading
from pathlib import Path
from typing import Any

import jax

from . import kept_kernels
from .kernel_headers import own_headers
from .standard_error import silent

# Warp's modules are built by one thread at a time.
ONE_AT_A_TIME = threading.RLock()
# One trajectory takes a GPU some thirty times as long as a core of a CPU: what that comes to for all of several cores.
LEAST_ON_GPUS = 1024
# Modules that are loaded, with the devices that they are loaded on.
_LOADED: set[tuple[Any, str]] = set()


def is_installed() -> bool:
    """Whether Warp can be imported."""
    return importlib.util.find_spec("warp") is not None


def warp() -> Any:
    """The module `warp`, initialised.

    **Raises:** `ImportError` where it is not installed.
    """
    with ONE_AT_A_TIME:
        return _initialised()


@functools.cache
def _initialised():
    try:
        import warp as wp
    except ImportError:
        raise ImportError(
            "This run's trajectories are followed by kernels of Warp, which is not installed here. Install it with "
            "`pip install warp-lang` on all machines of the run, or on none."
        ) from None
    # Where there is no CUDA driver, Warp's library says so on the process' standard error, whatever its settings.
    without_driver = ctypes.util.find_library("cuda") is None
    with _quietly(wp), silent() if without_driver else contextlib.nullcontext():
        if not _has_place(wp):
            # What Warp would take is a folder named ~ in the present one.
            wp.config.kernel_cache_dir = os.path.join("~", ".cache", "warp", wp.config.version)
            _init_elsewhere(wp)
        else:
            try:
                wp.init()
            except OSError:  # Warp does not begin without a folder of its own; fivjax's kernels do not need it
                _init_elsewhere(wp)
    return wp


def _has_place(wp) -> bool:
    """Whether Warp is told a folder for its kernels, or the user has a home folder for it."""
    named = wp.config.kernel_cache_dir, *map(os.environ.get, ("WARP_CACHE_PATH", "XDG_CACHE_HOME"))
    return any(named) or os.path.isabs(os.path.expanduser("~"))


def _init_elsewhere(wp) -> None:
    """Initialise Warp with a temporary folder, and leave its setting as it was: kernels of others fail as they would have."""
    before = wp.config.kernel_cache_dir
    with tempfile.TemporaryDirectory(prefix="fivjax-") as folder:
        wp.config.kernel_cache_dir = folder
        try:
            wp.init()
        finally:
            wp.config.kernel_cache_dir = before


def compiler_flags() -> str:
    """Those of all kernels on a CPU: with the same ones Warp compiles its own headers only once in a process."""
    # Products and sums in one, and more of the compiler's thought: each makes steps a tenth faster. Loops over few coordinates
    # are slower in vectors: an energy ledger takes five times as long. What is compared with itself is compared to see whether
    # it is a number. What a user has set for Warp comes last, and so counts.
    own = warp().config.cpu_compiler_flags or "-march=native"
    return f"-O3 -fno-vectorize -ffp-contract=fast -Wno-tautological-compare {own}"


def folder_of_texts() -> Path | None:
    """Where the code of kernels is kept, if it can be."""
    return kept_kernels.folder_of_texts(warp())


def gpus() -> list[str]:
    """The GPUs that kernels run on: all of them, or none where JAX is told to use the CPU only."""
    return [] if jax.config.jax_platforms == "cpu" else [device.alias for device in warp().get_cuda_devices()]


def gpus_for(trajectories: int) -> list[str]:
    """The GPUs that so many trajectories side by side are left to: none if a CPU has finished before."""
    return gpus() if trajectories >= LEAST_ON_GPUS else []


def load(module, names: list[str], own: bool = False) -> None:
    """Compile a Warp module for these devices, or find it among the kernels that are kept. The code may be all our `own`, with
    numbers and addresses for arguments: then it needs few of Warp's headers.
    """
    wp = warp()
    with ONE_AT_A_TIME, _quietly(wp):
        missing = [name for name in names if (module, name) not in _LOADED]
        if missing:
            kept_kernels.load(wp, module, missing, functools.partial(own_headers, wp) if own else None)
            _LOADED.update((module, name) for name in missing)


@contextlib.contextmanager
def _quietly(wp):
    before = wp.config.log_level
    wp.config.log_level = max(before, wp.LOG_ERROR)
    try:
        yield
    finally:
        wp.config.log_level = before
