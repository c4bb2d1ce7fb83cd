"""Python functions that XLA's programs call on a CPU, with the places of their arrays in memory.

Of XLA's interface in C (`xla/ffi/api/c_api.h` in jaxlib), which stays the same, what is needed for that.
"""

import ctypes
import functools
import traceback
from collections.abc import Callable, Sequence

import jax

_POINTER, _NUMBER, _SIZE = ctypes.c_void_p, ctypes.c_int, ctypes.c_size_t
# A question about the handler itself; and the stage in which a program runs.
ABOUT_HANDLER, RUNS = 1, 3
INTERNAL_ERROR = 13


class _Extension(ctypes.Structure):
    _fields_ = (("size", _SIZE), ("kind", _NUMBER), ("next", _POINTER))


class _Version(ctypes.Structure):
    _fields_ = (("size", _SIZE), ("extension", _POINTER), ("major", _NUMBER), ("minor", _NUMBER))


class _Metadata(ctypes.Structure):
    _fields_ = (("size", _SIZE), ("version", _Version), ("traits", ctypes.c_uint32))


class _AboutHandler(ctypes.Structure):
    _fields_ = (("base", _Extension), ("metadata", ctypes.POINTER(_Metadata)))


class _Buffer(ctypes.Structure):
    _fields_ = (
        ("size", _SIZE),
        ("extension", _POINTER),
        ("type", _NUMBER),
        ("address", _POINTER),
        ("axes", ctypes.c_int64),
        ("shape", ctypes.POINTER(ctypes.c_int64)),
    )


class _Buffers(ctypes.Structure):
    _fields_ = (
        ("size", _SIZE),
        ("extension", _POINTER),
        ("count", ctypes.c_int64),
        ("types", _POINTER),
        ("buffers", ctypes.POINTER(ctypes.POINTER(_Buffer))),
    )


class _Failure(ctypes.Structure):
    _fields_ = (("size", _SIZE), ("extension", _POINTER), ("message", ctypes.c_char_p), ("code", _NUMBER))


class _Interface(ctypes.Structure):
    _fields_ = (
        ("size", _SIZE),
        ("extension", _POINTER),
        ("version", _Version),
        ("internal", _POINTER),
        ("failed", ctypes.CFUNCTYPE(_POINTER, ctypes.POINTER(_Failure))),
    )


class _Call(ctypes.Structure):
    _fields_ = (
        ("size", _SIZE),
        ("extension", _POINTER),
        ("interface", ctypes.POINTER(_Interface)),
        ("context", _POINTER),
        ("stage", _NUMBER),
        ("given", _Buffers),
        ("found", _Buffers),
    )


_Handler = ctypes.CFUNCTYPE(_POINTER, ctypes.POINTER(_Call))
# What XLA may call has to stay in memory.
_HANDLERS: dict[str, _Handler] = {}

# Of each array its address and its shape.
Addresses = list[tuple[int, tuple[int, ...]]]


def called_by_xla(
    name: str, function: Callable[[Addresses], None]
) -> Callable[[Sequence[jax.ShapeDtypeStruct]], Callable]:
    """A function of JAX arrays, under `jit` on a CPU, for shapes and types of the results.

    `function` is told where the arrays are, then the results, which it writes; their content is arbitrary before.
    """
    # The version of the interface that is meant here; XLA says which versions it still understands.
    major, minor = 0, 1

    def handler(call) -> int | None:
        call = call.contents
        extension = ctypes.cast(call.extension, ctypes.POINTER(_Extension))
        if extension and extension.contents.kind == ABOUT_HANDLER:
            about = ctypes.cast(extension, ctypes.POINTER(_AboutHandler)).contents.metadata.contents
            about.version.major, about.version.minor = major, minor
            return None
        if call.stage != RUNS:
            return None
        try:
            function(
                [
                    _place(buffers.buffers[k].contents)
                    for buffers in (call.given, call.found)
                    for k in range(buffers.count)
                ]
            )
        except BaseException:
            message = traceback.format_exc().encode()
            return call.interface.contents.failed(_Failure(ctypes.sizeof(_Failure), None, message, INTERNAL_ERROR))
        return None

    if name not in _HANDLERS:
        _HANDLERS[name] = _Handler(handler)
        jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(_HANDLERS[name]), platform="cpu")
    return functools.partial(jax.ffi.ffi_call, name)


def _place(buffer: _Buffer) -> tuple[int, tuple[int, ...]]:
    return buffer.address or 0, tuple(buffer.shape[: buffer.axes])
