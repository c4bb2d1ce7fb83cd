"""The paper's oscillator: two masses on a moving belt, as a structure with seven parameters."""

import jax.numpy as jnp
import numpy as np

from ..foundation import arguments
from ..foundation.precision import in_double_precision, is_known
from .structure import Matrices, Structure


@in_double_precision
def belt_oscillator(m1=0.53, m2=0.045, c1=1.0, c2=1.0, k1=100e3, k2=101e3, theta=0.01) -> Structure:
    """The paper's mass on a moving belt, with the values of its Table 1 (matrices of Eq. 5).

    Coordinates `(x2, y1, y2)`: along the belt, vertical displacement of mass 1, normal to the belt. Mass 1 shares the
    horizontal motion of mass 2, so its position is `(x2 cosθ − y2 sinθ, y1)`; spring 1 ties that horizontal motion to
    the frame, and spring 2 acts on the difference of `y1` and the height `x2 sinθ + y2 cosθ` of mass 2.

    **Arguments:** masses `m1`, `m2` in kg; dampers `c1`, `c2` in N·s/m; springs `k1`, `k2` in N/m; belt inclination
    `theta` in rad.

    **Raises:** `ValueError` for masses that are not positive, negative dampers or springs, an angle beyond π, or a value that
    is not finite.

    **Example:**

        >>> stiffer = fj.belt_oscillator(k1=104e3)
        >>> stiffer.coordinates
        ('x2', 'y1', 'y2')
    """
    arguments.real_number("m1", m1, above=0)
    arguments.real_number("m2", m2, above=0)
    for name, value in {"c1": c1, "c2": c2, "k1": k1, "k2": k2}.items():
        arguments.real_number(name, value, minimum=0)
    arguments.real_number("theta", theta)
    if is_known(theta) and abs(float(theta)) > np.pi:
        raise ValueError(
            f"Argument `theta` must be an angle in rad, between -π and π, but is {float(theta):g}. Give degrees as "
            f"`np.radians({float(theta):g})`."
        )
    return Structure.from_parameters(
        _matrices,
        {"m1": m1, "m2": m2, "c1": c1, "c2": c2, "k1": k1, "k2": k2, "theta": theta},
        coordinates=("x2", "y1", "y2"),
        tangential=0,
        normal=2,
        dampers=("c1", "c2"),
        builder=belt_oscillator,
    )


def _matrices(m1, m2, c1, c2, k1, k2, theta) -> Matrices:
    """Eq. 5."""
    sin, cos = jnp.sin(theta), jnp.cos(theta)
    zero, one = jnp.zeros_like(sin), jnp.ones_like(sin)
    horizontal = jnp.stack([cos, zero, -sin])  # of both masses
    height_1 = jnp.stack([zero, one, zero])  # of mass 1
    height_2 = jnp.stack([sin, zero, cos])  # of mass 2

    def quadratic_form(weights_and_rows):
        return sum(weight * jnp.outer(row, row) for weight, row in weights_and_rows)

    return Matrices(
        mass=quadratic_form([(m1 + m2, horizontal), (m1, height_1), (m2, height_2)]),
        damping=quadratic_form([(c1, horizontal), (c2, height_1 - height_2)]),
        stiffness=quadratic_form([(k1, horizontal), (k2, height_1 - height_2)]),
        load_direction=-height_1,
    )
