"""Which motions kernels follow."""

import functools
import warnings
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from ..contact import Mechanics, status_from_forces
from ..foundation.argument_forms import Form
from ..foundation.plain_trees import PACKAGE
from ..kernels.code import traced_source
from ..kernels.warp_library import is_installed
from ..model.belt import belt_oscillator
from ..model.friction import Coulomb, ExponentialDecay
from ..model.load import Pulse
from ..model.scene import Scene
from .base import AbstractStepper
from .event_exact import EventExact

# Larger structures and more contacts are left to XLA: their kernels would have more code than they save.
LARGEST, MOST_CONTACTS = 48, 8
# The latest version of JAX whose primitives are known to have C++. In a later one it is looked whether a step has.
LATEST_JAX = (0, 12)


def has_kernel(scene: Scene, method: AbstractStepper, called_by_xla: bool = True) -> bool:
    """Whether a kernel follows the motions of such scenes by this method; on a CPU, if programs of XLA may call it."""
    if not isinstance(method, EventExact):
        return False
    if (lacking := _lacking()) is not None:
        _tell_once(*lacking)
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


def _lacking() -> tuple[str, str] | None:
    """Why no kernels can be built, and the remedy."""
    if not is_installed():
        return "Warp is not installed", "`pip install warp-lang` installs it"
    if not _steps_can_be_written():
        major, minor = LATEST_JAX
        return (
            f"JAX {jax.__version__} is later than this version knows",
            f"`pip install 'jax<{major}.{minor + 1}'` installs one that it knows",
        )
    return None


@functools.cache
def _tell_once(reason: str, remedy: str) -> None:
    warnings.warn(
        f"{reason}, so XLA follows motions in place of kernels. Results are the same to rounding, but first calls take up to a "
        f"minute more, and maps some forty times as long. {remedy}.",
        stacklevel=2,
    )


@functools.cache
def _steps_can_be_written() -> bool:
    """Whether a step can be written as C++: a later version of JAX may trace other primitives."""
    if jax.__version_info__[:2] <= LATEST_JAX:
        return True
    structure, load = belt_oscillator(), Pulse(100.0, 1.2)
    laws = Coulomb(0.2), ExponentialDecay(0.2, 0.1, 0.5)
    forms = [Form.of((Scene(structure, law, 1.0, load), np.zeros(2 * structure.size)))[0] for law in laws]
    return all(_failure_of_writing(_step, form) is None for form in forms)


def _step(args, instants):
    scene, y = args
    mechanics = Mechanics(scene)
    contact = status_from_forces(mechanics, scene.load.force, y)
    after = EventExact().advance(mechanics, contact, scene.load.force, y, jnp.asarray(0.1), at_section=True)
    return (after.y, after.contact.status), ()


def _laws_can_be_written(scene: Scene) -> bool:
    """Whether friction and load can be written as C++: of laws from elsewhere this is tried."""
    laws, count = (scene.friction, scene.load), len(scene.structure.contacts)
    kinds = [type(own) for own in (*laws, *getattr(scene.friction, "laws", ()))]
    if not (others := [kind for kind in kinds if kind.__module__.partition(".")[0] != PACKAGE]):
        return True
    form, _ = Form.of((*laws, np.zeros(() if count == 1 else count)))
    try:
        failure = _failure_of_writing(_values, form)
    except TypeError:  # it has fixed fields that cannot be told apart; or it fails, as XLA's trace will say
        return False
    if failure is not None:
        names = " and ".join(dict.fromkeys(f"`{kind.__name__}`" for kind in others))
        _tell_once(f"No kernel can be made of {names}", failure.rstrip("."))
    return failure is None


@functools.cache
def _failure_of_writing(function: Callable, form: Form) -> str | None:
    """Why a function has no C++, if it has none."""
    try:
        traced_source(function, form, ())
    except NotImplementedError as failure:
        return str(failure)
    return None


def _values(args, instants):
    """The values of laws, and how friction changes with time while slip does."""
    friction, load, slip = args
    values = [friction(slip), jax.vmap(friction)(jnp.stack([slip, slip]))]
    if not friction.constant:
        next_term = friction.in_time(slip, 3)
        values.append(next_term([slip, slip], values[:1]))
    jumps = load.jumps
    return (tuple(values), load(jnp.ravel(slip)[0]), jumps), ()
