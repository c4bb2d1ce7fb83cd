"""NVIDIA Warp, where it is installed: kernels of one thread for each trajectory, on a CPU or on GPUs.

It comes with fivjax where it has wheels. It is imported only where there are GPUs, or where its compiler cannot be used without
(`c_functions`), because that takes a third of a second.
"""

import contextlib
import ctypes
import functools
import hashlib
import importlib.util
import linecache
import os
import sys
import tempfile
import threading
from collections.abc import Generator, Sequence
from typing import Any

import jax

# Warp's modules are built by one thread at a time.
ONE_AT_A_TIME = threading.RLock()
# One trajectory takes a GPU some thirty times as long as a core of a CPU: what that comes to for all of several cores.
LEAST_ON_GPUS = 1024
# The environment variable with options for the compiler of kernels for CPUs.
FLAGS = "FIVJAX_KERNEL_FLAGS"
# The library of a CUDA driver, by the beginnings of what an operating system calls itself.
DRIVERS = {"linux": "libcuda.so.1", "win": "nvcuda.dll"}


@contextlib.contextmanager
def silent() -> Generator[None]:
    """Nothing reaches the process' standard error, to which a library writes past Python."""
    sys.stderr.flush()
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


@functools.cache
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
    with _quietly(wp), contextlib.nullcontext() if has_driver() else silent():
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


def compiler_flags(level: str = "-O3") -> str:
    """Those of all kernels on a CPU, at a level of optimisation. What the environment says comes last, and so counts."""
    # Products and sums are fused within statements, which makes steps a tenth faster, and powers are left to one function: the
    # digits are the same at every level. Loops over few coordinates are slower in vectors: an energy ledger takes five times as
    # long. No warnings: what is compared with itself is compared to see whether it is a number.
    own = os.environ.get(FLAGS, "")
    return f"{'' if '-O' in own else level} -march=native -fno-vectorize -ffp-contract=on -fno-builtin-pow -w {own}"


@functools.cache
def has_driver() -> bool:
    """Whether there is a CUDA driver."""
    name = next((name for system, name in DRIVERS.items() if sys.platform.startswith(system)), None)
    try:
        return name is not None and ctypes.CDLL(name) is not None
    except OSError:
        return False


def gpus() -> list[str]:
    """The GPUs that kernels run on: all of them, or none where JAX is told to use the CPU only."""
    if jax.config.jax_platforms == "cpu" or not has_driver():
        return []
    with ONE_AT_A_TIME:
        # A device that one thread has begun to make ready has no stream yet for another.
        return [device.alias for device in warp().get_cuda_devices() if device.context]


def gpus_for(trajectories: int) -> list[str]:
    """The GPUs that so many trajectories side by side are left to: none if a CPU has finished before."""
    return gpus() if trajectories >= LEAST_ON_GPUS else []


def warp_kernel(body: str, addresses: Sequence[str], numbers: Sequence[str]):
    """A kernel of one lane for each thread, from the body of a function of `lane` and of these."""
    wp = warp()
    signature = ", ".join([*(f"{name}: wp.uint64" for name in addresses), *(f"{name}: int" for name in numbers)])
    code = (
        f"@wp.func_native(body)\ndef of_lane(lane: int, {signature}): ...\n\n"
        f"def of_lanes(first: int, {signature}):\n    of_lane(first + wp.tid(), {', '.join((*addresses, *numbers))})\n"
    )
    name = hashlib.sha256(repr((body, code)).encode()).hexdigest()[:16]
    # Warp reads a kernel's source by `inspect`, which looks here.
    place = f"<fivjax kernel {name}>"
    linecache.cache[place] = (len(code), None, code.splitlines(keepends=True), place)
    space = {"wp": wp, "body": body}
    exec(compile(code, place, "exec"), space)
    module = wp.get_module(f"fivjax.kernel_{name}")
    module.options.update(max_unroll=1, cpu_compiler_flags=compiler_flags(), enable_backward=False)
    return wp.kernel(space["of_lanes"], enable_backward=False, module=module)


def launched(kernel, device: str, first: int, last: int, *args: int) -> None:
    """Run such a kernel for the lanes from `first` to before `last`."""
    wp = warp()
    # On a CPU Warp has blocks of one thread. What a module is compiled for has to be what it is launched with.
    block = 1 if device == "cpu" else 256
    with ONE_AT_A_TIME, _quietly(wp):
        kernel.module.load(device, block)
    wp.launch(kernel, dim=last - first, inputs=[first, *args], device=device, block_dim=block)


@contextlib.contextmanager
def _quietly(wp):
    before = wp.config.log_level
    wp.config.log_level = max(before, wp.LOG_ERROR)
    try:
        yield
    finally:
        wp.config.log_level = before
