"""Traced programs, kept for later processes in a folder of JAX's compilation cache.

That cache saves compilation only: to look a program up, JAX traces and lowers it first, which takes seconds for large ones. So
the traced program is kept, too (`jax.export`), as are other values that take long to make. The file name is a digest of all
that this depends on: fivjax's own source, the versions of Python, JAX, equinox and NumPy, the device, the function, shapes and
types of its arrays, and its other arguments.

A damaged file is removed and made anew. Where an argument has a class or function from outside (a user's own friction law), its
name does not tell what it does; such programs are traced in each process.
"""

import functools
import hashlib
import io
import os
import pickle
import platform
import tempfile
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, ParamSpec, TypeVar

import equinox as eqx
import jax
import numpy as np

from .compiling import compiled, less_thought, transformed

P = ParamSpec("P")
R = TypeVar("R")

# The folder inside that of the compilation cache, and how many bytes it may hold: what was used longest ago is removed first.
FOLDER, LARGEST = "fivjax-traced", 200 * 2**20
# What these packages define is fixed by their versions, or by fivjax's source.
KNOWN_PACKAGES = ("fivjax", "jax", "jaxlib", "equinox", "diffrax", "numpy", "builtins", "functools")
DIGEST_BYTES = 32


def kept(function: Callable[P, R], *, quickly_compiled: bool = True) -> Callable[P, R]:
    """`compiling.compiled`, or `equinox.filter_jit` unless `quickly_compiled`; where JAX has a compilation cache, the traced
    program is kept there for later processes.
    """
    otherwise = compiled(function) if quickly_compiled else eqx.filter_jit(function)
    programs: dict[Any, Callable | None] = {}
    lock = threading.Lock()

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        folder = _folder()
        if folder is None or transformed((args, kwargs)):
            return otherwise(*args, **kwargs)
        leaves, structure = jax.tree.flatten((args, kwargs))
        arrays = [leaf for leaf in leaves if eqx.is_array(leaf)]
        rest = tuple(_Array(leaf.shape, leaf.dtype.name) if eqx.is_array(leaf) else leaf for leaf in leaves)
        # A compiled program belongs to one device.
        key = folder, structure, rest, jax.config.jax_enable_x64, jax.config.jax_default_device
        if key not in programs:
            # Threads that want the same program wait for the one that makes it.
            with lock:
                if key not in programs:
                    programs[key] = _program(function, Path(folder), structure, rest, arrays, quickly_compiled)
        program = programs[key]
        return otherwise(*args, **kwargs) if program is None else program(arrays)

    return call


def kept_value(make: Callable[..., R], *args) -> R:
    """What a function makes of its arguments, which can be pickled and takes long to make; kept like traced programs."""
    folder = _folder()
    path = None if folder is None else _place(make, Path(folder), None, args)
    if path is None:
        return make(*args)
    found = _found(path, pickle.loads)
    if found is None:
        found = make(*args)
        _write(path, pickle.dumps(found))
    return found


class _Array(NamedTuple):
    """An argument that is an array."""

    shape: tuple[int, ...]
    dtype: str


class _Foreign(Exception):
    """Something whose name does not tell what it does."""


def _folder() -> str | None:
    folder = jax.config.jax_compilation_cache_dir
    return None if folder is None or "://" in folder else os.path.join(folder, FOLDER)


def _program(
    function: Callable, folder: Path, structure, rest: tuple, arrays: Sequence, quickly_compiled: bool
) -> Callable | None:
    """A function of the arrays, read from the folder or made and written there; none where it cannot be named."""
    path = _place(function, folder, structure, rest)
    if path is None:
        return None
    options = less_thought() if quickly_compiled else {}

    def ready(text: bytes) -> Callable:
        from jax import export

        exported, form = pickle.loads(text)
        exported = export.deserialize(bytearray(exported))
        run = jax.jit(exported.call, compiler_options=options).lower(*arrays).compile()
        result = jax.tree.structure(form)
        return lambda arrays: jax.tree.unflatten(result, run(*arrays))

    found = _found(path, ready)
    if found is not None:
        return found
    try:
        text = _traced(function, structure, rest, arrays)
    except (_Foreign, pickle.PicklingError, AttributeError, NotImplementedError):
        return None
    _write(path, text)
    return ready(text)


def _place(function: Callable, folder: Path, structure, rest: tuple) -> Path | None:
    """The file for what a function makes of such arguments; none where these cannot be named."""
    try:
        return folder / f"{function.__name__}-{_digest(function, structure, rest)}"
    except (_Foreign, pickle.PicklingError, AttributeError, TypeError):
        return None


def _found(path: Path, ready: Callable[[bytes], R]) -> R | None:
    """What is made ready from a file; none where there is no such file."""
    try:
        found = ready(_read(path))
        os.utime(path)
        return found
    except OSError:  # not there
        pass
    except Exception:  # damaged, or of a kind that this JAX does not read: made anew
        path.unlink(missing_ok=True)
    return None


def _traced(function: Callable, structure, rest: tuple, arrays: Sequence) -> bytes:
    """The function traced for such arrays, and the form of its result."""
    forms = []

    def of_arrays(*arrays):
        own = iter(arrays)
        leaves = [next(own) if isinstance(one, _Array) else one for one in rest]
        args, kwargs = jax.tree.unflatten(structure, leaves)
        result = function(*args, **kwargs)
        forms.append(jax.tree.structure(result))
        return jax.tree.leaves(result)

    from jax import export

    exported = export.export(jax.jit(of_arrays))(*(jax.ShapeDtypeStruct(a.shape, a.dtype) for a in arrays))
    return _pickled((bytes(exported.serialize()), _with_zeros(forms[-1])))


def _digest(function: Callable, structure, rest: tuple) -> str:
    versions = [f"{package.__name__} {package.__version__}" for package in (jax, eqx, np)]
    device = jax.devices()[0]
    built_on = [
        *versions,
        platform.python_version(),
        device.platform,
        device.device_kind,
        str(jax.config.jax_enable_x64),
    ]
    name = f"{function.__module__}.{function.__qualname__}"
    return hashlib.sha256(_pickled((_source(), built_on, name, structure, rest))).hexdigest()[:40]


@functools.cache
def _source() -> str:
    """A digest of fivjax's own source."""
    digest = hashlib.sha256()
    root = Path(__file__).parents[1]
    for path in sorted(root.rglob("*.py")):
        digest.update(str(path.relative_to(root)).encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


class _Pickler(pickle.Pickler):
    """Refuses classes and functions of other packages, because pickle would only write their names. The structure of a tree
    is written as such a tree of zeros.
    """

    def reducer_override(self, obj):
        if isinstance(obj, jax.tree_util.PyTreeDef):
            return jax.tree.structure, (_with_zeros(obj),)
        if isinstance(obj, type) or (callable(obj) and hasattr(obj, "__qualname__")):
            package = (getattr(obj, "__module__", None) or "").partition(".")[0]
            if package not in KNOWN_PACKAGES:
                raise _Foreign(repr(obj))
        return NotImplemented


def _pickled(what) -> bytes:
    buffer = io.BytesIO()
    pickler = _Pickler(buffer, protocol=5)
    # Without memoisation: with it, the result would depend on which of several equal strings are the same object.
    pickler.fast = True
    pickler.dump(what)
    return buffer.getvalue()


def _with_zeros(structure):
    return jax.tree.unflatten(structure, [0.0] * structure.num_leaves)


def _read(path: Path) -> bytes:
    data = path.read_bytes()
    digest, text = data[:DIGEST_BYTES], data[DIGEST_BYTES:]
    if hashlib.sha256(text).digest() != digest:
        raise ValueError(f"{path} is damaged.")
    return text


def _write(path: Path, text: bytes) -> None:
    """Writes a file whole or not at all; in a folder that cannot be written to, nothing is kept."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=path.parent)
        with os.fdopen(handle, "wb") as file:
            file.write(hashlib.sha256(text).digest() + text)
        os.replace(name, path)
        _make_room(path.parent)
    except OSError:
        return


def _make_room(folder: Path) -> None:
    """Removes what was used longest ago, until the rest is small enough."""
    files = sorted(((file.stat().st_mtime, file.stat().st_size, file) for file in folder.iterdir()), reverse=True)
    total = 0
    for _, size, file in files:
        total += size
        if total > LARGEST:
            file.unlink(missing_ok=True)
