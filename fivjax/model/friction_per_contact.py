"""Friction laws of several contacts, one for each."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..foundation import arguments
from .friction import AbstractFriction


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
    def constant(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return all(law.constant for law in self.laws)

    @property
    def static(self) -> Float[Array, " c"]:
        return jnp.stack([jnp.asarray(law.static) for law in self.laws])

    @property
    def parameters(self) -> dict[str, Array]:
        """The laws' parameters, each with its contact's number: `mu_0`, `mu_1`, …"""
        return {
            f"{name}_{i}": value
            for i, law in enumerate(self.laws)
            for name, value in vars(law).items()
            if eqx.is_inexact_array(value)
        }

    def replace(self, **changes) -> "FrictionPerContact":
        """With other values of some of the parameters."""
        laws = []
        for i, law in enumerate(self.laws):
            own = {name: value for name, value in vars(law).items() if value is not None}
            changed = {name: changes[f"{name}_{i}"] for name in own if f"{name}_{i}" in changes}
            laws.append(type(law)(**{**own, **changed}) if changed else law)
        return FrictionPerContact(laws)

    def check(self) -> None:
        for law in self.laws:
            law.check()

    def __call__(self, slip_speed: Float[Array, " c"]) -> Float[Array, " c"]:
        return jnp.stack([law(slip_speed[..., i]) for i, law in enumerate(self.laws)], axis=-1)

    def next_term(self, slip: list[Float[Array, " c"]], friction: list[Float[Array, " c"]]) -> Float[Array, " c"]:
        def of(law, i):
            own = [term[..., i] for term in slip], [term[..., i] for term in friction]
            return jnp.zeros_like(own[0][0]) if law.constant else law.next_term(*own)

        return jnp.stack([of(law, i) for i, law in enumerate(self.laws)], axis=-1)

    def variation(self, slip_speed: Float[Array, " c"]) -> tuple[Float[Array, " c"], Float[Array, " c"]]:
        slopes, bends = zip(*(law.variation(slip_speed[..., i]) for i, law in enumerate(self.laws)), strict=True)
        return jnp.stack(slopes, axis=-1), jnp.stack(bends, axis=-1)

    def __repr__(self) -> str:
        return repr(list(self.laws))
