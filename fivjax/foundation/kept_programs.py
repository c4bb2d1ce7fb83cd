"""Compiled programs, kept for later processes in a folder of JAX's compilation cache, or where there is none in fivjax's own.

JAX's own cache saves compilation only: to look a program up, JAX traces and lowers it first, which takes seconds for large
ones. So the traced program is kept beside it (`jax.export`), or without that cache the compiled one (`kept_executables`); as
are other values that take long to make. The file name is a digest of all that this depends on: fivjax's own source, the
versions of Python and of the libraries whose code is traced, the device and the processor, the function, shapes and types of
its arrays, and its other arguments.

A file has a program as JAX writes it, and the form of its result as text (`plain_trees`); nothing in it is unpickled. A damaged
file is removed and made anew. Where an argument has a class or function from outside (a user's own friction law), its name does
not tell what it does; such programs are traced in each process. `FIVJAX_KEEP_PROGRAMS=0` keeps nothing in fivjax's own folder.
"""

import contextlib
import functools
import hashlib
import io
import os
import pickle
import platform
import threading
import uuid
from collections.abc import Callable, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax

from .argument_forms import ArrayForm, Form
from .compiling import compiled, quick_compiler_options, transformed
from .forking import refuse_if_forked
from .kept_executables import NotSerializable, can_serialize, know_what_it_calls, program_from, serialized
from .kept_folder import folder_of_caches, folder_to_keep_in, keep, make_room, read_kept
from .plain_trees import NotPlain, from_text, structure_to_text, to_text, with_zeros

P = ParamSpec("P")
R = TypeVar("R")

# The folder inside that of the compilation cache, and how many bytes it may hold: what was used longest ago is removed first.
FOLDER, LARGEST = "fivjax-traced", 200 * 2**20
# Set to 0, it keeps nothing where JAX has no compilation cache.
OPT_OUT = "FIVJAX_KEEP_PROGRAMS"
# What a file holds: a compiled program, or a traced one.
EXECUTABLE, TRACED = b"executable", b"traced"
# Libraries whose code may be in a program. What they define is fixed by their versions.
LIBRARIES = ("jax", "jaxlib", "equinox", "diffrax", "optimistix", "lineax", "numpy", "warp-lang")
# What these packages define is fixed by their versions, or by fivjax's source.
KNOWN_PACKAGES = ("fivjax", "builtins", "functools", *LIBRARIES)


def kept(function: Callable[P, R], *, quickly_compiled: bool = True) -> Callable[P, R]:
    """`compiling.compiled`, or `equinox.filter_jit` unless `quickly_compiled`; and the program is kept for later processes."""
    otherwise = compiled(function) if quickly_compiled else eqx.filter_jit(function)
    programs: dict[Any, Callable | None] = {}
    lock = threading.Lock()

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        refuse_if_forked()
        folder = _folder()
        if folder is None or transformed((args, kwargs)):
            return otherwise(*args, **kwargs)
        leaves, structure = jax.tree.flatten((args, kwargs))
        arrays = [leaf for leaf in leaves if eqx.is_array(leaf)]
        # Unlike `Form.of`: by the arrays' own types, and numbers of Python's are no arrays.
        told = (ArrayForm(leaf.shape, leaf.dtype.name) if eqx.is_array(leaf) else leaf for leaf in leaves)
        form = Form(structure, tuple(told))
        # A compiled program belongs to one device.
        key = folder, form, jax.config.jax_enable_x64, jax.config.jax_default_device
        if key not in programs:
            # Threads that want the same program wait for the one that makes it.
            with lock:
                if key not in programs:
                    programs[key] = _program(function, form, arrays, quickly_compiled)
        program = programs[key]
        if program is not None:
            try:
                return program(arrays)
            except jax.errors.JaxRuntimeError:  # whatever was kept does not run here
                programs[key] = None
        return otherwise(*args, **kwargs)

    return call


def kept_value(make: Callable[..., R], *args) -> R:
    """What a function makes of its arguments: plain values (`plain_trees`) that take long to make. Kept like programs."""
    path = _place(make, args)
    if path is None:
        return make(*args)
    found = _found(path, from_text)
    if found is None:
        found = make(*args)
        with contextlib.suppress(NotPlain):
            keep_code(path, to_text(found).encode())
    return found


class _Foreign(Exception):
    """Something whose name does not tell what it does."""


def _folder() -> str | None:
    """The folder inside that of JAX's compilation cache, if there is one, else fivjax's own."""
    folder = jax.config.jax_compilation_cache_dir
    if folder:
        return None if "://" in folder else os.path.join(folder, FOLDER)
    if os.environ.get(OPT_OUT, "") == "0":
        return None
    home = folder_of_caches()
    return None if home is None else str(home / "fivjax" / FOLDER)


def _program(function: Callable, form: Form, arrays: Sequence, quickly_compiled: bool) -> Callable | None:
    """A function of the arrays, read from the folder or made and written there; none where it cannot be named."""
    path = _place(function, form)
    if path is None:
        return None
    options = quick_compiler_options() if quickly_compiled else {}

    def ready(content: bytes) -> Callable:
        kind, structure, program = content.split(b"\0", 2)
        result = from_text(structure)
        if kind == EXECUTABLE:
            run = program_from(program)
            return lambda arrays: jax.tree.unflatten(result, run(arrays))
        from jax import export

        know_what_it_calls(program)
        exported = export.deserialize(bytearray(program))
        compiled = jax.jit(exported.call, compiler_options=options).lower(*arrays).compile()
        return lambda arrays: jax.tree.unflatten(result, compiled(*arrays))

    found = _found(path, ready)
    if found is not None:
        return found
    try:
        content, program = _made(function, form, arrays, options)
    except (NotPlain, NotImplementedError, ValueError):  # what `jax.export` refuses
        return None
    keep_code(path, content)
    return ready(content) if program is None else program


def place_of_code(name: str) -> Path | None:
    """The file with this name in the folder for compiled code; none where nothing can be kept."""
    folder = _folder()
    place = folder_to_keep_in(folder) if folder else None
    return None if place is None else place / name


def keep_code(path: Path, content: bytes) -> None:
    """Write a file of that folder, and make room for it."""
    keep(path, content)
    make_room(path.parent, LARGEST)


def _place(function: Callable, given: tuple) -> Path | None:
    """The file for what a function makes of such arguments; none where these cannot be named, or nothing can be kept."""
    named = _named(function, given) if _folder() else None
    return None if named is None else place_of_code(named)


def _named(function: Callable, given: tuple) -> str | None:
    try:
        return f"{function.__name__}-{_digest(function, given)}"
    except (_Foreign, pickle.PicklingError, AttributeError, TypeError):
        return None


def _found(path: Path, ready: Callable[[bytes], R]) -> R | None:
    """What is made ready from a file; none where there is no such file."""
    content = read_kept(path)
    if content is None:
        return None
    try:
        return ready(content)
    except Exception:  # of a kind that this JAX does not read: made anew
        path.unlink(missing_ok=True)
        return None


def _made(function: Callable, form: Form, arrays: Sequence, options) -> tuple[bytes, Callable | None]:
    """A function compiled for such arrays: what is kept of it, and a function of the arrays. Where the compiled program cannot
    be kept, the traced one is, and is left to be compiled.
    """
    structures = []

    def of_arrays(*arrays):
        args, kwargs = form.args(arrays)
        result = function(*args, **kwargs)
        structures.append(jax.tree.structure(result))
        return jax.tree.leaves(result)

    # By this name a profiler knows the program.
    of_arrays.__name__ = getattr(function, "__name__", of_arrays.__name__)
    like = [jax.ShapeDtypeStruct(array.shape, array.dtype) for array in arrays]
    if can_serialize():
        lowered = jax.jit(of_arrays, keep_unused=True, compiler_options=options).lower(*like)
        told, compiled = structure_to_text(structures[-1]).encode(), lowered.compile()
        result = structures[-1]
        with contextlib.suppress(NotSerializable):
            content = b"\0".join([EXECUTABLE, told, serialized(lowered, compiled)])
            return content, lambda arrays: jax.tree.unflatten(result, compiled(*arrays))
    from jax import export

    exported = export.export(jax.jit(of_arrays))(*like)
    told = structure_to_text(structures[-1]).encode()
    return b"\0".join([TRACED, told, exported.serialize()]), None


def _digest(function: Callable, given: tuple) -> str:
    device = jax.devices()[0]
    built_on = [
        *_versions(),
        platform.python_version(),
        device.platform,
        device.device_kind,
        str(len(jax.devices())),
        _processor(),
        str(jax.config.jax_enable_x64),
        os.environ.get("XLA_FLAGS", ""),
    ]
    name = f"{function.__module__}.{function.__qualname__}"
    return hashlib.sha256(_pickled((_source(), built_on, name, given))).hexdigest()[:40]


@functools.cache
def _processor() -> str:
    """What instructions it has, as far as the system tells: several machines may share a home folder."""
    try:
        told = Path("/proc/cpuinfo").read_text(errors="replace").partition("\n\n")[0]
        features = [line for line in told.splitlines() if line.lower().startswith(("flags", "features"))]
    except OSError:
        features = []
    return " ".join([platform.machine(), *(features or [platform.processor()])])


@functools.cache
def _versions() -> list[str]:
    """Those of the libraries that are installed."""
    found = {name: list(metadata.distributions(name=name)) for name in LIBRARIES}
    return [f"{name} {one.version}" for name, those in found.items() for one in those[:1]]


ROOT = Path(__file__).parents[1]


def _stamps() -> list[tuple[str, int, int]]:
    """The files of fivjax's own source, with their times and sizes."""
    # Editors leave links that lead nowhere beside what they edit.
    told = ((path, path.stat()) for path in sorted(ROOT.rglob("*.py")) if path.is_file())
    return [(str(path.relative_to(ROOT)), stat.st_mtime_ns, stat.st_size) for path, stat in told]


# While this module is imported, as all others are.
IMPORTED = _stamps()


@functools.cache
def _source() -> str:
    """A digest of fivjax's own source; where that was changed after it was imported, one that no other process has."""
    digest = hashlib.sha256()
    for name, *_ in IMPORTED:
        path = ROOT / name
        digest.update(name.encode() + b"\0" + (path.read_bytes() if path.exists() else b""))
    return digest.hexdigest() if _stamps() == IMPORTED else uuid.uuid4().hex


class _Pickler(pickle.Pickler):
    """Writes what is digested; nothing is read back. Refuses classes and functions of other packages, because pickle would only
    write their names. The structure of a tree is written as such a tree of zeros.
    """

    def reducer_override(self, obj):
        if isinstance(obj, jax.tree_util.PyTreeDef):
            return jax.tree.structure, (with_zeros(obj),)
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
