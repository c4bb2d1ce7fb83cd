"""Compiled programs as bytes, so that a later process neither traces nor compiles them.

Only programs for a single CPU, which call nothing in this process but LAPACK: other calls are to addresses of the process that
compiled them.
"""

import re
from collections.abc import Callable, Sequence

import jax
from jax.extend.backend import get_backend

from .matrix_routines import register

# What calls of LAPACK are named by jaxlib.
LAPACK = "lapack_"


class NotSerializable(Exception):
    """A program that cannot be kept as bytes."""


def can_serialize() -> bool:
    """Whether programs of this process may be kept as bytes.

    Not where JAX has a compilation cache: what it has read from there lacks functions once it is written again.
    """
    alone = jax.default_backend() == "cpu" and len(jax.devices()) == 1 and jax.process_count() == 1
    return alone and not jax.config.jax_compilation_cache_dir


def serialized(lowered, compiled) -> bytes:
    """A program that JAX has lowered and compiled, as bytes.

    **Raises:** `NotSerializable` for one that calls other code, or where this JAX has no way to do it.
    """
    called = set(re.findall(r"custom_call @([\w.$]+)", lowered.as_text()))
    if not all(name.startswith(LAPACK) for name in called):
        raise NotSerializable(f"It calls {', '.join(sorted(called))}.")
    try:
        content = compiled.runtime_executable().serialize()
        program_from(content)  # whether a later process can load it
        return content
    except Exception as error:  # of a kind that JAX does not document
        raise NotSerializable(str(error)) from None


def know_what_it_calls(content: bytes) -> None:
    """Register what a program calls of LAPACK, if it does: JAX 0.8 ends the process otherwise."""
    if LAPACK.encode() in content:
        register()


def program_from(content: bytes) -> Callable[[Sequence], list[jax.Array]]:
    """A program from its bytes, as a function of all its arrays. The bytes must be what `serialized` gave, on such a machine.

    **Raises:** whatever JAX raises for bytes that it cannot load.
    """
    # In this version of JAX, where devices are listed is not public; another one raises, and the program is compiled anew.
    from jaxlib import xla_client

    know_what_it_calls(content)
    devices = xla_client.DeviceList(tuple(jax.devices()))
    executable = get_backend().deserialize_executable(content, devices, None)

    def run(arrays: Sequence) -> list[jax.Array]:
        # Not by `jnp.asarray`, which inside a caller's derivative gives tracers, of known numbers, too.
        found = executable.execute_sharded(jax.device_put(list(arrays)))
        # Waited for, so that a program that cannot run fails here, where another can take its place.
        return jax.block_until_ready([of_device[0] for of_device in found.disassemble_into_single_device_arrays()])

    return run
