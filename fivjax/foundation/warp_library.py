"""NVIDIA Warp, where it is installed: kernels of one thread for each trajectory, on a CPU or on GPUs.

It is an extra (`pip install "fivjax[gpu]"`), so it is imported only where it is used.
"""

import contextlib
import ctypes.util
import functools
import importlib.util
import os
import sys
import threading
from typing import Any

import jax

# Warp's modules are built by one thread at a time.
ONE_AT_A_TIME = threading.RLock()


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
            '`pip install "fivjax[gpu]"` on all machines of the run, or on none.'
        ) from None
    with _quietly(wp), _without_stderr():
        wp.init()
    return wp


def devices() -> list[str]:
    """Where kernels run: on all GPUs, or on the CPU, where there is none or where JAX is told to use the CPU only."""
    gpus = [] if jax.config.jax_platforms == "cpu" else warp().get_cuda_devices()
    return [device.alias for device in gpus] or ["cpu"]


def load(module, names: list[str]) -> None:
    """Compile a Warp module for these devices, or find it in Warp's own cache."""
    wp = warp()
    with ONE_AT_A_TIME, _quietly(wp):
        for name in names:
            # A kernel on a CPU is compiled anew for each size of a block of threads; there it is one.
            wp.load_module(module, name, block_dim=1 if name == "cpu" else None)


@contextlib.contextmanager
def _without_stderr():
    """Where there is no CUDA driver, Warp's library says so on the process' standard error, whatever its settings."""
    if ctypes.util.find_library("cuda") is not None:
        yield
        return
    sys.stderr.flush()
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


@contextlib.contextmanager
def _quietly(wp):
    before = wp.config.log_level
    wp.config.log_level = max(before, wp.LOG_ERROR)
    try:
        yield
    finally:
        wp.config.log_level = before
