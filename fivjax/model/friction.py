"""Friction laws: the coefficient of friction as a function of slip speed.

A law is a callable of the slip speed |v_rel| ≥ 0 (m/s). The direction of slip, and whether the contact slides at all, are
worked out in `contact`.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..foundation import arguments
from ..foundation.digits import apart
from ..foundation.jaxprs import is_rounded_to_single
from ..foundation.precision import in_double_precision, is_known, real, state_for_pickle, state_from_pickle
from ..foundation.smoothness import is_smooth
from ..foundation.taylor import composed, taylor_coefficients
from .printing import as_call

# Gives the next Taylor coefficient in time of μ, from those of the slip speed up to the same order and from those of μ so far.
NextTerm = Callable[[list[Array], list[Array]], Array]


class AbstractFriction(eqx.Module):
    r"""A friction law: what `contact` and the verdicts ask of one, and what they rely on.

    - `law(v)` is the coefficient at slip speed $v \ge 0$ in m/s: any JAX function that is continuous, with loops, branches
      and tables if need be, from one real number in double precision to another. Where it has a kink, steps end there.
    - `static`, the largest |T|/N that a sticking contact holds, is at least μ(0): a contact with less static than sliding
      friction would chatter without end. Unless defined, it is μ(0). At higher speeds μ may exceed it.
    - `variation(v)` bounds $|μ'|$ and $|μ''|$ at and above $v$ (in s/m and s²/m²): proofs that sliding goes on rest on it.
      Unless defined, nothing is known, and such verdicts stay undecided.
    - `constant` says that μ never changes.
    - `smooth` says whether μ has no kinks, at speeds above zero. Unless said, that is read from the code: a law that compares,
      clips, takes from a table, or takes a root or the inverse of what may be zero may have some. Then a bound on $|μ''|$ is
      worth nothing and is not used.

    A scene checks this where values are known, at slip speeds from 0 to ten times the belt's, and holds the law's numbers in
    double precision. Fields are the law's parameters; what `replace` and maps change must be a field that the constructor takes
    by the same name.

    **Example:**

        >>> isinstance(scene.friction, fj.AbstractFriction)
        True

    `docs/extending.md` shows how to write a law of your own.
    """

    __getstate__, __setstate__ = state_for_pickle, state_from_pickle

    # Constant friction makes the motion in every status linear; exact methods rest on that.
    constant: ClassVar[bool] = False
    smooth: ClassVar[bool | None] = None

    @property
    def static(self) -> Float[Array, ""]:
        """The largest |T|/N that a sticking contact can hold."""
        return self(jnp.zeros(()))

    def __call__(self, slip_speed: Float[Array, ""]) -> Float[Array, ""]:
        """The coefficient of friction while sliding at this slip speed."""
        raise NotImplementedError(f"The friction law `{type(self).__name__}` must define `__call__(self, slip_speed)`.")

    def variation(self, slip_speed: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Bounds on |μ'| (s/m) and |μ''| (s²/m²) at and above this slip speed, for proofs about the future."""
        unknown = jnp.full_like(slip_speed, jnp.inf)
        return unknown, unknown

    @property
    def may_have_kinks(self) -> Bool[Array, ""] | np.bool_:
        """Whether the law is not certain to be smooth; traced, if that depends on parameters that are."""
        if self.smooth is not None:
            return np.bool_(not self.smooth)
        with jax.enable_x64(True):
            return ~is_smooth(self, jnp.zeros(()))

    def bounds(self, slip_speed: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """`variation` as far as proofs may rely on it: without a bound on |μ''| where the law may have kinks."""
        slope, bend = self.variation(slip_speed)
        return slope, jnp.where(self.may_have_kinks, jnp.inf, bend)

    def largest(self, fastest: Float[Array, "*contacts"]) -> Float[Array, "*contacts"]:
        """The largest coefficient from rest to each of these slip speeds (m/s), as far as looking at some speeds shows."""
        # Slip speeds at which the largest coefficient of a law is looked for, as shares of the fastest.
        looked_at = np.linspace(0.0, 1.0, 33)
        speeds = jnp.multiply.outer(looked_at, fastest)
        # A law is one of a single speed.
        mu = jax.vmap(self)(jnp.ravel(speeds)).reshape(speeds.shape)
        return jnp.maximum(self.static, jnp.max(mu, axis=0))

    def in_time(self, slip_speed: Float[Array, ""], order: int) -> NextTerm:
        """How the Taylor series in time of μ goes on from this slip speed, up to some order."""
        coefficients, powers = taylor_coefficients(self, slip_speed, order), []
        return lambda slip, _: composed(coefficients, slip, powers)

    def check(self, belt_speed: Array | float = 0.0) -> None:
        """Refuse a law that breaks its contract, where its values are known, on a belt of this speed (m/s)."""
        self._check_result()
        fastest = float(np.max(np.abs(np.asarray(belt_speed)))) if is_known(belt_speed) else 0.0
        # A law is checked at these shares of the fastest slip that is looked at: so many times the belt's speed, or so many
        # m/s where that is zero or unknown.
        shares = np.concatenate([[0.0], np.geomspace(1e-9, 1.0, 121)])
        times = 10.0
        speeds = times * (fastest or 1.0) * shares
        static = self.static
        mu, slope, bend, bounds, jumps = _sample(self, jnp.asarray(speeds))
        if not all(map(is_known, (static, mu))):
            return
        static, mu, name = float(static), np.asarray(mu), type(self).__name__

        def refuse(wrong, rule: str):
            if np.any(wrong):
                at = int(np.argmax(wrong))
                found, highest = apart(mu[at], static)
                raise ValueError(
                    f"The friction law `{name}` must {rule}, but is {found} at a slip speed of {speeds[at]:g} m/s, with "
                    f"`static` {highest}. See `fivjax.AbstractFriction` for what a law promises."
                )

        refuse(~np.isfinite(mu) | ~np.isfinite(static), "be finite at every slip speed")
        refuse(mu < 0, "not be negative")
        # A law written as a sum may exceed its own largest value by rounding.
        refuse(mu[:1] > static * (1 + 1e-12), "be at most `static` at rest")
        if self.constant:
            refuse(mu != mu[0], "not change with slip speed where `constant` is true")
        if self.may_have_kinks:
            # Where slip is driven back over a jump, friction would change to and fro without end.
            refuse(jumps > 1e-9 * np.maximum(static, np.max(mu)), "be continuous: it jumps near this speed")
        for what, values, bound in (("|μ'|", slope, bounds[0]), ("|μ''|", bend, bounds[1])):
            # The largest value at this speed and above.
            largest = np.maximum.accumulate(np.abs(values)[::-1])[::-1]
            refuse(largest > np.asarray(bound) * (1 + 1e-9) + 1e-12, f"stay within the bound of `variation` on {what}")

    def check_for_several(self, contacts: int) -> None:
        """Refuse a law of one speed only as the law of so many contacts."""
        with jax.enable_x64(True):
            try:
                found = jax.eval_shape(self.__call__, jax.ShapeDtypeStruct((contacts,), np.dtype("float64")))
            except (TypeError, ValueError):
                found = None
        # What does not change with speed may be one number for all.
        if getattr(found, "shape", None) not in ([(), (contacts,)] if self.constant else [(contacts,)]):
            raise TypeError(
                f"The friction law `{type(self).__name__}` takes one slip speed only, but is that of {contacts} contacts. Use "
                "`jnp.where` in place of `jax.lax.cond` in it, or give each contact its law: `friction=[law, law, …]`."
            )

    def _check_result(self) -> None:
        """Refuse a law that is no JAX function from a real number to a real number in double precision."""
        name, more = type(self).__name__, "See `fivjax.AbstractFriction` for what a law promises."
        with jax.enable_x64(True):
            speed = jax.ShapeDtypeStruct((), np.dtype("float64"))
            try:
                traced, found = jax.make_jaxpr(lambda speed: self(speed), return_shape=True)(speed)
            except arguments.NEEDS_NUMBERS as error:
                raise TypeError(
                    f"The friction law `{name}` must be a JAX function, but asks for a value while it is traced. "
                    f"Use `jax.numpy` in place of NumPy, and `jnp.where` in place of `if`. {more}"
                ) from error
        if not isinstance(found, jax.ShapeDtypeStruct) or found.shape != () or found.dtype != speed.dtype:
            kind = f"{found.dtype} of shape {found.shape}" if isinstance(found, jax.ShapeDtypeStruct) else f"{found!r}"
            raise TypeError(
                f"The friction law `{name}` must return one real number in double precision (float64 of shape ()), but returns "
                f"{kind}. {more}"
            )
        if is_rounded_to_single(traced.jaxpr):
            raise TypeError(
                f"The friction law `{name}` must compute in double precision, but rounds to single precision on the way: its "
                f"steps could not be exact. Leave out `astype`, and make arrays by `np.asarray`. {more}"
            )

    def __repr__(self) -> str:
        return as_call(type(self).__name__, vars(self))


def numeric_fields(part: eqx.Module) -> dict[str, Array]:
    """The fields of a law or a load that are its parameters, by name: whole numbers, say, and fixed fields are none."""
    fixed = [field.name for field in dataclasses.fields(part) if field.metadata.get("static", False)]
    # `eqx.tree_at` may have put in a number of Python's.
    known: dict[str, Any] = {
        name: np.float64(value) if isinstance(value, float) else value
        for name, value in vars(part).items()
        if name not in fixed
    }
    return {name: value for name, value in known.items() if eqx.is_inexact_array(value)}


def rebuilt(part, changes: Mapping):
    """A law or a load with other values of some fields, made by its constructor, to which those without a value are left.

    **Raises:** `TypeError` for a constructor that asks for numbers that are traced.
    """
    own = {name: value for name, value in vars(part).items() if value is not None}
    try:
        return type(part)(**{name: changes.get(name, value) for name, value in own.items()})
    except arguments.NEEDS_NUMBERS as error:
        raise TypeError(
            f"The constructor of `{type(part).__name__}` must take what JAX traces, but asks for a number, as `float(…)` and "
            f"`if` do. Keep what it is given by `jnp.asarray`, and leave checks of values to where these are known."
        ) from error


def slope_of(law: AbstractFriction, slip_speed: Float[Array, "*contacts"]) -> Float[Array, "*contacts"]:
    """dμ/dv at a slip speed, in s/m. Forward, because a law may have loops that JAX cannot differentiate in reverse."""
    return jax.jvp(law, (slip_speed,), (jnp.ones_like(slip_speed),))[1]


@eqx.filter_jit
def _sample(law: AbstractFriction, speeds: Float[Array, " k"]):
    def slope(speed):
        return slope_of(law, speed)

    return (
        jax.vmap(law)(speeds),
        jax.vmap(slope)(speeds),
        jax.vmap(lambda speed: jax.jvp(slope, (speed,), (jnp.ones_like(speed),))[1])(speeds),
        jax.vmap(law.bounds)(speeds),
        jnp.append(jax.vmap(lambda low, high: _jump(law, low, high))(speeds[:-1], speeds[1:]), 0.0),
    )


def _jump(law: AbstractFriction, low: Float[Array, ""], high: Float[Array, ""]) -> Float[Array, ""]:
    """By how much a law changes in the shortest interval between two speeds: always the half in which it changes more."""

    def bisect(_, ends):
        (low, of_low), (high, of_high) = ends
        middle = 0.5 * (low + high)
        of_middle = law(middle)
        below = jnp.abs(of_middle - of_low) >= jnp.abs(of_high - of_middle)
        ends = (low, of_low), (middle, of_middle), (high, of_high)
        return jax.tree.map(lambda a, b: jnp.where(below, a, b), ends[:2], ends[1:])

    # Halvings of an interval until what is left of a change is a jump.
    halvings = 50
    (_, of_low), (_, of_high) = jax.lax.fori_loop(0, halvings, bisect, ((low, law(low)), (high, law(high))))
    return jnp.abs(of_high - of_low)


class Coulomb(AbstractFriction):
    """Constant friction.

    **Arguments:** `mu`, the coefficient while sliding; `mu_static`, the one that sticking can hold, `mu` unless given
    (both without unit).

    **Raises:** `ValueError` if a coefficient is negative or not finite, or if `mu_static` is below `mu`.

    **Example:**

        >>> law = fj.Coulomb(mu=0.3, mu_static=0.4)
        >>> bool(law.constant)
        True
    """

    mu: Float[Array, ""]
    mu_static: Float[Array, ""] | None
    constant = True

    @in_double_precision
    def __init__(self, mu, mu_static=None):
        arguments.real_number("mu", mu, minimum=0)
        if mu_static is not None:
            arguments.real_number("mu_static", mu_static, minimum=0)
            _check_order("mu_static", mu_static, "mu", mu)
        self.mu = real(mu)
        self.mu_static = None if mu_static is None else real(mu_static)

    @property
    def static(self) -> Float[Array, ""]:
        return self.mu if self.mu_static is None else self.mu_static

    def check(self, belt_speed: Array | float = 0.0) -> None:
        """Nothing is left to check: the constructor has."""

    def largest(self, fastest: Float[Array, ""]) -> Float[Array, ""]:
        return self.static

    def __call__(self, slip_speed: Float[Array, ""]) -> Float[Array, ""]:
        return self.mu

    def variation(self, slip_speed: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        return jnp.zeros_like(slip_speed), jnp.zeros_like(slip_speed)


class ExponentialDecay(AbstractFriction):
    r"""Friction that falls with slip speed, $\mu = \mu_d + (\mu_s - \mu_d)\, e^{-d |v_{rel}|}$ (Eq. 1).

    **Arguments:** `mu_static` $\mu_s$ and `mu_dynamic` $\mu_d$ without unit, `decay` $d$ in s/m.

    **Raises:** `ValueError` if a value is negative or not finite, or if `mu_static` is below `mu_dynamic`.

    **Example:**

        >>> law = fj.ExponentialDecay(mu_static=0.2, mu_dynamic=0.1, decay=0.5)
        >>> float(law.static), bool(law.constant)
        (0.2, False)
    """

    mu_static: Float[Array, ""]
    mu_dynamic: Float[Array, ""]
    decay: Float[Array, ""]
    constant = False

    @in_double_precision
    def __init__(self, mu_static, mu_dynamic, decay=0.5):
        arguments.real_number("mu_static", mu_static, minimum=0)
        arguments.real_number("mu_dynamic", mu_dynamic, minimum=0)
        arguments.real_number("decay", decay, minimum=0)
        _check_order("mu_static", mu_static, "mu_dynamic", mu_dynamic)
        self.mu_static, self.mu_dynamic, self.decay = real(mu_static), real(mu_dynamic), real(decay)

    @property
    def static(self) -> Float[Array, ""]:
        return self.mu_static

    def check(self, belt_speed: Array | float = 0.0) -> None:
        """Nothing is left to check: the constructor has."""

    def largest(self, fastest: Float[Array, ""]) -> Float[Array, ""]:
        return self.static

    def __call__(self, slip_speed: Float[Array, ""]) -> Float[Array, ""]:
        return self.mu_dynamic + (self.mu_static - self.mu_dynamic) * jnp.exp(-self.decay * slip_speed)

    def in_time(self, slip_speed: Float[Array, ""], order: int) -> NextTerm:
        # By the recurrence Ė = -d u̇ E.
        def next_term(slip, friction):
            order = len(slip) - 1
            falling = [friction[0] - self.mu_dynamic, *friction[1:]]
            return -self.decay / order * sum(j * slip[j] * falling[order - j] for j in range(1, order + 1))

        return next_term

    def variation(self, slip_speed: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        # Both derivatives shrink in size with slip speed, so the bound is the value at the lower end.
        slope = self.decay * (self(slip_speed) - self.mu_dynamic)
        return slope, self.decay * slope


def _check_order(high_name: str, high, low_name: str, low) -> None:
    if is_known(high) and is_known(low) and float(high) < float(low):
        larger, smaller = apart(high, low)
        raise ValueError(
            f"Argument `{high_name}` must be at least `{low_name}`, but is {larger} and `{low_name}` is "
            f"{smaller}. A contact that slips more easily while it sticks would chatter without end; are the two swapped?"
        )
