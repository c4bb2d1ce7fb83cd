"""Processes forked from one that has used JAX. A fork copies no threads, so a computation by JAX in it would wait for ever.

A process that is forked before JAX has computed anything is able to compute.
"""

import os

from jax._src import xla_bridge

_cut_off = False


def refuse_if_forked() -> None:
    """Called before anything is compiled or computed.

    **Raises:** `RuntimeError` in a process that cannot compute.
    """
    if _cut_off:
        raise RuntimeError(
            "This process was forked from one that had already used JAX, so that JAX would wait here for ever. Start processes "
            'afresh: `multiprocessing.get_context("spawn")` or "forkserver", in PyTorch `DataLoader(..., '
            'multiprocessing_context="spawn")`.'
        )


def _note_fork() -> None:
    global _cut_off
    # This function is not public. Without it nobody can tell, and a refusal is better than a process that hangs.
    in_use = getattr(xla_bridge, "backends_are_initialized", None)
    _cut_off = in_use is None or in_use()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_note_fork)
