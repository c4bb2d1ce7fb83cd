"""Which motions kernels follow."""

import functools
import warnings

import jax
import jax.numpy as jnp
import numpy as np

from ..foundation.argument_forms import Form
from ..foundation.plain_trees import PACKAGE
from ..kernels.code import traced_source
from ..kernels.warp_library import is_installed
from ..model.scene import Scene
from .base import AbstractStepper
from .event_exact import EventExact

# Larger structures and more contacts are left to XLA: their kernels would have more code than they save.
LARGEST, MOST_CONTACTS = 48, 4


def has_kernel(scene: Scene, method: AbstractStepper, called_by_xla: bool = True) -> bool:
    """Whether a kernel follows the motions of such scenes by this method; on a CPU, if programs of XLA may call it."""
    if not isinstance(method, EventExact):
        return False
    if not is_installed():
        _tell_once()
        return False
    return (
        (not called_by_xla or jax.default_backend() == "cpu")
        and scene.structure.size <= LARGEST
        and len(scene.structure.places) <= MOST_CONTACTS
        and _laws_can_be_written(scene)
    )


def goes_side_by_side(scene: Scene) -> bool:
    """Whether many motions of such scenes take less time side by side in a processor's vectors: with more contacts, all of them
    wait in most steps for an event of one.
    """
    return len(scene.structure.contacts) <= 3


@functools.cache
def _tell_once() -> None:
    warnings.warn(
        "Warp is not installed, so XLA follows motions in place of kernels. Results are the same to rounding, but first calls "
        "take up to a minute more, and maps some forty times as long. `pip install warp-lang` installs it.",
        stacklevel=2,
    )


def _laws_can_be_written(scene: Scene) -> bool:
    """Whether friction and load can be written as C++: of laws from elsewhere this is tried."""
    laws, count = (scene.friction, scene.load), len(scene.structure.contacts)
    if all(type(own).__module__.partition(".")[0] == PACKAGE for own in (*laws, *getattr(scene.friction, "laws", ()))):
        return True
    form, _ = Form.of((*laws, np.zeros(() if count == 1 else count)))
    try:
        return _can_be_written(form)
    except TypeError:  # it has fixed fields that cannot be told apart; or it fails, as XLA's trace will say
        return False


@functools.cache
def _can_be_written(form: Form) -> bool:
    try:
        traced_source(_values, form, ())
    except NotImplementedError:
        return False
    return True


def _values(args, instants):
    """The values of laws, and how friction changes with time while slip does."""
    friction, load, slip = args
    values = [friction(slip)]
    if not friction.constant:
        next_term = friction.in_time(slip, 3)
        values.append(next_term([slip, slip], values))
    jumps = load.jumps
    return (tuple(values), load(jnp.ravel(slip)[0]), jumps), ()
