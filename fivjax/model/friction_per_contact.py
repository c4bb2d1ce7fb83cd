"""Friction laws of several contacts, one for each."""

import functools
import operator
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..foundation import arguments
from .friction import AbstractFriction, NextTerm, numeric_fields, rebuilt


class FrictionPerContact(AbstractFriction):
    """A friction law for each contact; slip speeds and coefficients have a last axis over the contacts.

    **Raises:** `TypeError` for anything but a list of friction laws.
    """

    laws: tuple[AbstractFriction, ...]

    def __init__(self, laws: Sequence[AbstractFriction]):
        if not isinstance(laws, Sequence) or not laws:
            raise TypeError(
                f"Argument `friction` must be a friction law or a list of them, but is {arguments.describe(laws)}."
            )
        for i, law in enumerate(laws):
            arguments.instance(f"friction[{i}]", law, AbstractFriction, "a friction law, such as Coulomb(mu=0.2)")
        self.laws = tuple(laws)

    # A class variable of the base class, but here it depends on the laws.
    @property
    def constant(self) -> bool:
        return all(law.constant for law in self.laws)

    @property
    def static(self) -> Float[Array, " c"]:
        return jnp.stack([jnp.asarray(law.static) for law in self.laws])

    @property
    def parameters(self) -> dict[str, Array]:
        """The laws' parameters, each with its contact's number: `mu_0`, `mu_1`, …"""
        return {f"{name}_{i}": value for i, law in enumerate(self.laws) for name, value in numeric_fields(law).items()}

    def replace(self, **changes) -> "FrictionPerContact":
        """With other values of some of the parameters."""
        laws = []
        for i, law in enumerate(self.laws):
            changed = {name: changes[f"{name}_{i}"] for name in vars(law) if f"{name}_{i}" in changes}
            laws.append(rebuilt(law, changed) if changed else law)
        return FrictionPerContact(laws)

    @property
    def may_have_kinks(self) -> Bool[Array, ""] | np.bool_:
        return functools.reduce(operator.or_, (law.may_have_kinks for law in self.laws))

    def check(self, belt_speed: Array | float = 0.0) -> None:
        for law in self.laws:
            law.check(belt_speed)

    def __call__(self, slip_speed: Float[Array, " c"]) -> Float[Array, " c"]:
        return self._of_each(lambda law, slip: law(slip), slip_speed)

    def largest(self, fastest: Float[Array, "*c"]) -> Float[Array, " c"]:
        return self._of_each(lambda law, own: law.largest(own), jnp.broadcast_to(fastest, len(self.laws)))

    def in_time(self, slip_speed: Float[Array, " c"], order: int) -> NextTerm:
        parts = [None if law.constant else law.in_time(slip_speed[..., i], order) for i, law in enumerate(self.laws)]

        def next_term(slip, friction):
            def of(part, i):
                own = [term[..., i] for term in slip], [term[..., i] for term in friction]
                return jnp.zeros_like(own[0][0]) if part is None else part(*own)

            return jnp.stack([of(part, i) for i, part in enumerate(parts)], axis=-1)

        return next_term

    def variation(self, slip_speed: Float[Array, " c"]) -> tuple[Float[Array, " c"], Float[Array, " c"]]:
        return self._of_each(lambda law, slip: tuple(law.variation(slip)), slip_speed)

    def bounds(self, slip_speed: Float[Array, " c"]) -> tuple[Float[Array, " c"], Float[Array, " c"]]:
        return self._of_each(lambda law, slip: tuple(law.bounds(slip)), slip_speed)

    def _of_each(self, function, speeds):
        found = [function(law, speeds[..., i]) for i, law in enumerate(self.laws)]
        return jax.tree.map(lambda *own: jnp.stack(own, axis=-1), *found)

    def __repr__(self) -> str:
        return repr(list(self.laws))
