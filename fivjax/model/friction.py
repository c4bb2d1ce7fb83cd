"""Friction laws: the coefficient of friction as a function of slip speed.

A law is a callable of the slip speed |v_rel| ≥ 0 (m/s). The direction of slip, and whether the contact slides at all, are
worked out in `contact`. Laws are smooth in the slip speed, also a little below zero, so that a step may go past the instant
where sliding ends.
"""

import abc
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.jet import jet
from jaxtyping import Array, Float

from ..foundation import arguments
from ..foundation.digits import apart
from ..foundation.precision import in_double_precision, is_known, real
from .printing import as_call

# Slip speeds at which a law is checked, in m/s.
SPEEDS = np.concatenate([[0.0], np.geomspace(1e-6, 1e6, 121)])


class AbstractFriction(eqx.Module):
    r"""A friction law: what `contact` and the verdicts ask of one, and what they rely on.

    - `law(v)` is the coefficient at slip speed $v \ge 0$ in m/s, smooth and also defined a little below zero.
    - $0 \le μ(v) \le$ `static` for all $v \ge 0$: a contact with less static than sliding friction would chatter without end,
      and Painlevé's limit is checked with `static`.
    - `variation(v)` bounds $|μ'|$ and $|μ''|$ at and above $v$ (in s/m and s²/m²): proofs that sliding goes on rest on it.
    - `constant` says that μ never changes.

    A scene checks this where values are known, at slip speeds from 0 to 1e6 m/s, and holds the law's numbers in double
    precision. Fields are the law's parameters; what `replace` and maps change must be a field that the constructor takes by
    the same name.

    **Example:**

        >>> isinstance(scene.friction, fj.AbstractFriction)
        True

    `docs/extending.md` shows how to write a law of your own.
    """

    # Constant friction makes the motion in every status linear; exact methods rest on that.
    constant: eqx.AbstractClassVar[bool]

    @property
    @abc.abstractmethod
    def static(self) -> Float[Array, ""]:
        """The largest |T|/N that a sticking contact can hold."""

    @abc.abstractmethod
    def __call__(self, slip_speed: Float[Array, ""]) -> Float[Array, ""]:
        """The coefficient of friction while sliding at this slip speed."""

    def check(self) -> None:
        """Refuse a law that breaks its contract, where its values are known."""
        static, speeds = self.static, jnp.asarray(SPEEDS)
        mu, slope, bend, bounds = _sampled(self, speeds)
        if not all(map(is_known, (static, mu))):
            return
        static, mu, name = float(static), np.asarray(mu), type(self).__name__

        def refuse(wrong, rule: str):
            if np.any(wrong):
                at = int(np.argmax(wrong))
                found, highest = apart(mu[at], static)
                raise ValueError(
                    f"The friction law `{name}` must {rule}, but is {found} at a slip speed of {SPEEDS[at]:g} m/s, with "
                    f"`static` {highest}. See `fivjax.AbstractFriction` for what a law promises."
                )

        refuse(~np.isfinite(mu) | ~np.isfinite(static), "be finite at every slip speed")
        refuse(mu < 0, "not be negative")
        # A law written as a sum may exceed its own largest value by rounding.
        refuse(mu > static * (1 + 1e-12), "be at most `static` at every slip speed")
        if self.constant:
            refuse(mu != mu[0], "not change with slip speed where `constant` is true")
        for what, values, bound in (("|μ'|", slope, bounds[0]), ("|μ''|", bend, bounds[1])):
            # The largest value at this speed and above.
            largest = np.maximum.accumulate(np.abs(values)[::-1])[::-1]
            refuse(largest > np.asarray(bound) * (1 + 1e-9) + 1e-12, f"stay within the bound of `variation` on {what}")

    def next_term(self, slip: list[Float[Array, ""]], friction: list[Float[Array, ""]]) -> Float[Array, ""]:
        """The next Taylor coefficient in time of μ, from those of the slip speed up to the same order (at least one).

        `friction` has the coefficients of μ that are known already; a law with a recurrence formula may need only these.
        """
        del friction
        order = len(slip) - 1
        derivatives = [math.factorial(k) * slip[k] for k in range(1, order + 1)]
        _, series = jet(self.__call__, (slip[0],), (derivatives,))
        return series[-1] / math.factorial(order)

    @abc.abstractmethod
    def variation(self, slip_speed: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Bounds on |μ'| (s/m) and |μ''| (s²/m²) at and above this slip speed, for proofs about the future."""

    def __repr__(self) -> str:
        return as_call(type(self).__name__, vars(self))


@jax.jit
def _sampled(law: AbstractFriction, speeds: Float[Array, " k"]):
    slope = jax.grad(law)
    return (
        jax.vmap(law)(speeds),
        jax.vmap(slope)(speeds),
        jax.vmap(jax.grad(slope))(speeds),
        jax.vmap(law.variation)(speeds),
    )


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

    def check(self) -> None:
        """Nothing is left to check: the constructor has."""

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

    def check(self) -> None:
        """Nothing is left to check: the constructor has."""

    def __call__(self, slip_speed: Float[Array, ""]) -> Float[Array, ""]:
        return self.mu_dynamic + (self.mu_static - self.mu_dynamic) * jnp.exp(-self.decay * slip_speed)

    def next_term(self, slip: list[Float[Array, ""]], friction: list[Float[Array, ""]]) -> Float[Array, ""]:
        # The recurrence Ė = -d u̇ E takes one more term; the general way computes all orders anew each time.
        order = len(slip) - 1
        falling = [friction[0] - self.mu_dynamic, *friction[1:]]
        return -self.decay / order * sum(j * slip[j] * falling[order - j] for j in range(1, order + 1))

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
