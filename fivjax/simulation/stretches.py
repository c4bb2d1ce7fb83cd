r"""From one saved instant to the next, and the derivative of that.

A stretch takes as many advances as it needs; the number is known only afterwards. Forward-mode derivatives are carried along.
For reverse mode there are two ways:

- JAX's own, through a loop of bounded length; it works in both modes, and its cost is that of the bound, not of the advances
  that were made;
- "reverse": a stretch maps a few dozen numbers (state, mechanics, load, time) to a few. Its whole Jacobian is computed in
  forward mode when the backward pass comes to it. The cost hardly depends on the number of parameters of the scene, only the
  start of the stretch is kept in memory, and the result is that of forward mode to the last digits.
"""

import equinox as eqx
import jax
import jax.flatten_util
import numpy as np
from jaxtyping import Array, Bool, Float

from ..contact import Contact, Mechanics, State
from ..steppers.base import AbstractStepper
from ..steppers.core import Segment, follow
from ..steppers.event_exact import for_derivatives
from . import energy as accounts
from .energy import EnergyData, Ledger

MODES = ("both", "forward", "reverse", "none")


class Begin(eqx.Module):
    """Everything that a stretch depends on."""

    mechanics: Mechanics
    contact: Contact
    load: Float[Array, ""]
    y: State
    h: Float[Array, ""]  # s
    ledger: Ledger | None
    energy_data: EnergyData | None


End = tuple[State, Contact, Ledger | None, Bool[Array, ""]]


def go_on(begin: Begin, method: AbstractStepper, most: int | Array, derivatives: str | None) -> End:
    """State, contact and ledger after the time `begin.h`; and whether `most` advances were enough."""
    if derivatives != "reverse":
        return _advances(begin, method, most, derivatives)
    return _reversible(begin, method, most)


def _advances(begin: Begin, method: AbstractStepper, most: int | Array, derivatives: str | None) -> End:
    mechanics, load, energy_data = begin.mechanics, begin.load, begin.energy_data
    if derivatives is not None:
        # Anew in each stretch, because its reverse derivative may use nothing computed outside of it.
        method = for_derivatives(method)

    def enter(ledger, segment: Segment):
        return accounts.entered(energy_data, method, mechanics, ledger, segment)

    after = follow(
        method,
        mechanics,
        begin.contact,
        load,
        begin.y,
        begin.h,
        total=begin.ledger,
        observe=enter,
        # The ledger counts crossings of the section.
        at_section=energy_data is not None,
        most=most,
        kind="bounded" if derivatives == "both" else "lax",
    )
    return after.y, after.contact, after.total, after.enough


def _reversible(begin: Begin, method: AbstractStepper, most: int | Array) -> End:
    # The method belongs to the numbers, too: its step may be an array.
    numbers, rest = eqx.partition((begin, method), eqx.is_inexact_array)
    counts, names = eqx.partition(rest, eqx.is_array)

    def end(numbers, counts):
        begin, method = eqx.combine(numbers, counts, names)
        return _advances(begin, method, most, "reverse")

    def backward(start, cotangent):
        numbers, counts = start
        flat, unravel = jax.flatten_util.ravel_pytree(numbers)

        def flat_end(flat):
            return jax.flatten_util.ravel_pytree(eqx.filter(end(unravel(flat), counts), eqx.is_inexact_array))[0]

        # Counts have no derivative.
        cotangent = jax.tree.map(lambda ct: None if ct.dtype == jax.dtypes.float0 else ct, cotangent)
        cotangent = jax.flatten_util.ravel_pytree(cotangent)[0]
        zeros = jax.tree.map(lambda leaf: np.zeros(leaf.shape, jax.dtypes.float0), counts)
        return unravel(cotangent @ jax.jacfwd(flat_end)(flat)), zeros

    stretch = jax.custom_vjp(end)
    stretch.defvjp(lambda numbers, counts: (end(numbers, counts), (numbers, counts)), backward)
    return stretch(numbers, counts)
