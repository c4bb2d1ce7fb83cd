"""Functions in C++, compiled for this processor by the compiler that Warp brings along, and called by `ctypes`.

Warp's own Python is not imported for them: that takes longer than most kernels run. How it calls its compiler is read from its
source instead. Where that is not as here, or there is no such compiler, `compiler` is None, and kernels are left to Warp.
"""

import ctypes
import functools
import hashlib
import importlib.util
import os
import re
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from ..foundation.kept_folder import read_kept
from ..foundation.kept_programs import keep_code, place_of_code
from ..foundation.whole_files import own_folder

# The library of the compiler, and that of Warp's core, by the beginnings of what an operating system calls itself.
LIBRARIES = {
    "linux": ("warp-clang.so", "warp.so"),
    "darwin": ("libwarp-clang.dylib", "libwarp.dylib"),
    "win": ("warp-clang.dll", "warp.dll"),
}
_TEXT, _FLAG, _NUMBER = ctypes.c_char_p, ctypes.c_bool, ctypes.c_int
# What these functions of the compiler take.
INTERFACE = {
    "wp_compile_cpp": (
        *(_TEXT,) * 4,  # code, its place, folder of headers, place of what is compiled
        *(_FLAG,) * 4,  # for debugging, with checks of numbers, with products and sums in one, with tiles on the stack
        ctypes.POINTER(_TEXT),  # options
        _NUMBER,  # level of optimisation
        *(_FLAG,) * 2,  # with messages, with compiled headers
        _TEXT,  # the folder of these
        _NUMBER,  # threads in a block
    ),
    "wp_load_obj_from_bytes": (ctypes.c_void_p, ctypes.c_size_t, _TEXT, _FLAG),
    "wp_llvm_set_cpu_block_runtime": (ctypes.c_void_p,),
}
TEXTS = ("wp_warp_clang_version", "wp_llvm_version", "wp_get_cpu_target_triple", "wp_get_host_cpu_features")
# The functions of C that code may call, of one number and of two; Warp calls them so on GPUs.
ANGLES = ("sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh")
OF_ONE = (*ANGLES, "sqrt", "cbrt", "exp", "log", "erf", "erfc", "floor", "ceil", "round", "rint")
OF_TWO = ("pow", "atan2")

_LOADED: set[bytes] = set()
_LOADING: dict[bytes, threading.Lock] = {}
_beginning = threading.Lock()


class Compiler(NamedTuple):
    """The compiler for this processor."""

    library: ctypes.CDLL
    target: str  # what compiled code depends on besides its source and options


@functools.cache
def compiler() -> Compiler | None:
    """The compiler; None where there is none that is called as here."""
    spec = importlib.util.find_spec("warp")
    names = next((names for system, names in LIBRARIES.items() if sys.platform.startswith(system)), None)
    if spec is None or spec.origin is None or names is None:
        return None
    home = Path(spec.origin).parent
    try:
        if not _is_declared((home / "_src" / "context.py").read_text(encoding="utf-8")):
            return None
        library, core = (ctypes.CDLL(str(home / "bin" / name)) for name in names)
        for name, types in INTERFACE.items():
            getattr(library, name).argtypes = types
        library.wp_lookup.argtypes, library.wp_lookup.restype = (_TEXT, _TEXT), ctypes.c_uint64
        for name in TEXTS:
            getattr(library, name).restype = _TEXT
        core.wp_cpu_block_runtime_get_api.restype = ctypes.c_void_p
        if not library.wp_llvm_set_cpu_block_runtime(core.wp_cpu_block_runtime_get_api()):
            return None
        target = b" ".join(getattr(library, name)() or b"" for name in TEXTS).decode()
    except (OSError, UnicodeDecodeError, AttributeError):
        return None
    return Compiler(library, target)


def _is_declared(text: str) -> bool:
    """Whether Warp says in its source that these functions take what is said here."""
    for name, types in INTERFACE.items():
        declared = re.search(rf"\.{name}\.argtypes = \[(.*?)\]", text, re.DOTALL)
        if declared is None:
            return False
        told = re.findall(r"ctypes\.(POINTER\(ctypes\.)?(\w+)", re.sub(r"#.*", "", declared[1]))
        found = [getattr(ctypes, name, None) for _, name in told]
        if [ctypes.POINTER(kind) if to else kind for kind, (to, _) in zip(found, told, strict=True)] != list(types):
            return False
    return True


def c_function(source: str, name: str, types: Sequence, flags: str) -> Callable:
    """The function with this name in C++ code, of arguments of these types, without a result. While it runs, other threads may.

    Compiled code is kept for later processes.

    **Raises:** `OSError` where no folder has room for compiling it.
    """
    own, code = compiler(), f"{_declarations()}\n{source}"
    assert own is not None
    digest = _digest(own, code, flags)
    module = f"fivjax_{digest}".encode()
    # Others may be compiled meanwhile.
    with _beginning:
        loading = _LOADING.setdefault(module, threading.Lock())
    with loading:
        if module not in _LOADED:
            place = _place(digest)
            kept = None if place is None else read_kept(place)
            # What cannot be loaded is compiled anew.
            if kept is None or not _loaded(own, kept, module):
                compiled = _compiled(own, code, flags, place)
                if place is not None:
                    keep_code(place, compiled)
                if not _loaded(own, compiled, module):
                    raise OSError(f"The compiled function `{name}` cannot be loaded.")
            _LOADED.add(module)
        address = _address(own, module, name.encode())
    return ctypes.CFUNCTYPE(None, *types)(address)


def is_kept(source: str, flags: str) -> bool:
    """Whether an earlier process has left what `c_function` compiles of this code."""
    own = compiler()
    place = None if own is None else _place(_digest(own, f"{_declarations()}\n{source}", flags))
    return place is not None and place.is_file()


def _digest(own: Compiler, code: str, flags: str) -> str:
    return hashlib.sha256("\0".join((code, flags, own.target)).encode()).hexdigest()[:40]


def _place(digest: str) -> Path | None:
    return place_of_code(f"kernel-{digest}")


def _address(own: Compiler, module: bytes, name: bytes) -> int:
    return own.library.wp_lookup(module, name)


def _loaded(own: Compiler, compiled: bytes, module: bytes) -> bool:
    return own.library.wp_load_obj_from_bytes(compiled, len(compiled), module, False) == 0


def _compiled(own: Compiler, code: str, flags: str, kept: Path | None) -> bytes:
    options = (_TEXT * (len(flags.split()) + 1))(*map(str.encode, flags.split()), None)
    failures = []
    for parent in _with_room(failures, None if kept is None else kept.parent):
        try:
            with own_folder(parent) as folder:
                paths = (str(folder / name).encode() for name in ("code.cpp", "headers", "code.o"))
                # How much thought is given to the processor's instructions.
                level = 0 if _level(flags) in ("-O0", "-O1") else 3
                fixed = False, False, True, True, options, level, False, False, None, 1
                if own.library.wp_compile_cpp(code.encode(), *paths, *fixed):
                    raise RuntimeError(
                        f"Code of a kernel does not compile with the options {flags.strip()}; please report it."
                    )
                return (folder / "code.o").read_bytes()
        except OSError as error:
            failures.append(f"{parent}: {error.strerror or error}")
    raise OSError(f"Kernels cannot be built, because no folder has room for that ({'; '.join(failures)})")


def _level(flags: str) -> str | None:
    """The level of optimisation that these options ask for: the last one counts."""
    return next((flag for flag in reversed(flags.split()) if flag.startswith("-O")), None)


def _with_room(failures: list[str], kept: Path | None) -> Iterator[Path]:
    """Folders that have room for compiling; why others have not is added to the failures."""
    # Room for what is compiled, in bytes: where the disk is full, the compiler ends the whole process.
    room = 2**26
    try:
        temporary = [Path(tempfile.gettempdir())]
    except OSError as error:
        temporary = []
        failures.append(str(error.strerror))
    for parent in (*temporary, Path("/dev/shm"), kept):
        if parent is None or not parent.is_dir():
            continue
        try:
            with own_folder(parent) as probe, open(probe / "room", "wb", buffering=0) as file:
                if hasattr(os, "posix_fallocate"):
                    os.posix_fallocate(file.fileno(), 0, room)
                else:
                    file.write(bytes(room))
        except OSError as error:
            failures.append(f"{parent}: {error.strerror or error}")
            continue
        yield parent


@functools.cache
def _declarations() -> str:
    """Functions of C, and by the names that Warp has for them."""
    numbers = {**dict.fromkeys(OF_ONE, ("x",)), **dict.fromkeys(OF_TWO, ("x", "y")), "fabs": ("x",)}
    lines = ["#define CUDA_CALLABLE"]
    for name, own in numbers.items():
        told = f"{name}({', '.join(f'double {number}' for number in own)})"
        lines.append(f'extern "C" double {told};')
        lines.append(f"namespace wp {{ inline double {told} {{ return ::{name}({', '.join(own)}); }} }}")
    return "\n".join([*lines, "namespace wp { inline double abs(double x) { return ::fabs(x); } }"])
