"""Stability of steady sliding over two parameters, in one batch."""

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from ..contact import Mechanics, slides_uniquely
from ..foundation.kept_programs import kept
from ..foundation.matrix_routines import eigenvalues
from ..foundation.precision import in_double_precision, real
from ..io.datasets import check_axis_names, labelled
from ..model.scene import Scene, steady_sliding
from ..model.structure import Structure
from .linearisation import sliding_motion, steady_matrices, time_scale
from .polynomials import characteristic_polynomial
from .routh_hurwitz import LARGEST_EXPANDED, hurwitz_determinants
from .system import with_axes

if TYPE_CHECKING:
    import xarray as xr


@in_double_precision
def chart(system: Structure | Scene, *, direction: int = 1, **parameters) -> "xr.Dataset":
    r"""Growth rate of steady sliding over any two parameters, in one batch.

        c = fj.cea.chart(fj.belt_oscillator(), mu=np.linspace(0, 0.5, 1000), k1=np.linspace(80e3, 120e3, 1000))

    Growth rates are from the eigenvalues of the state matrix, `margin` from Routh–Hurwitz; it is left out above 4 sliding
    coordinates, and with several contacts.

    **Arguments:**

    - `system`: a structure, or a scene where friction depends on speed.
    - `**parameters`: two axes, each one-dimensional and strictly increasing, by name: `mu` or a parameter of the
      structure; for a scene, anything in `scene.parameters` that steady sliding depends on. Single numbers replace the
      system's own value.
    - `direction`: for a structure, +1 for a belt that moves along the tangential coordinate, -1 against it.

    **Returns:** a dataset over the two axes with `growth_rate` (1/s, of the fastest growing mode), `frequency` of
    that mode (Hz), `margin` (the smallest Hurwitz determinant, positive where stable, without unit; one contact, up to 4
    sliding coordinates) and, for a scene, `normal_force` of steady sliding (N; with several contacts the smallest). NaN where
    there is no steady sliding, or where it is not unique.

    **Raises:** `ValueError` for anything but two axes, unknown names, and values that the structure or scene refuses.

    **Example:**

        >>> chart = fj.cea.chart(structure, mu=np.linspace(0.0, 0.5, 11), k1=np.linspace(90e3, 110e3, 5))
    """
    import xarray as xr

    scene, axes = with_axes(system, direction, parameters, count=2)
    check_axis_names(axes, ("growth_rate", "frequency", "margin", "normal_force"), "stability charts")
    grid = np.meshgrid(*axes.values(), indexing="ij")
    shape = grid[0].shape
    columns = [values.ravel() for values in grid]
    points = columns[0].size
    expanded = _is_expanded(scene.structure)
    # Points that are computed together: each needs a matrix.
    batch = min(64, points)
    padding = -points % batch
    columns = [np.concatenate([c, np.repeat(c[-1:], padding)]).reshape(-1, batch) for c in columns]
    results = _chart(scene, tuple(axes), [real(c) for c in columns])
    growth_rate, frequency, smallest, normal_force = (np.asarray(r).ravel()[:points].reshape(shape) for r in results)
    variables = {
        "growth_rate": (growth_rate, "growth rate of the fastest growing mode", "1/s"),
        "frequency": (frequency, "frequency of the fastest growing mode", "Hz"),
        "margin": (smallest, "smallest Hurwitz determinant, positive where stable", "1"),
    }
    if not expanded:
        # Determinants with hundreds of rows at every point would take longer than everything else.
        del variables["margin"]
    if isinstance(system, Scene):
        variables["normal_force"] = (normal_force, "normal force of steady sliding", "N")
    dataset = xr.Dataset(
        {name: (tuple(axes), v, {"long_name": long, "units": unit}) for name, (v, long, unit) in variables.items()},
        coords=axes,
    )
    method = "eigenvalues, Routh-Hurwitz" if expanded else "eigenvalues"
    return labelled(dataset, scene, analysis="stability chart", method=method)


@kept
def _chart(scene, names, columns):
    def at(*values):
        point = scene.replace(**dict(zip(names, values, strict=True)))
        matrix, forces = sliding_motion(point)
        ok = _slides(point, forces) & jnp.all(jnp.isfinite(matrix)) & slides_uniquely(Mechanics(point))
        roots = eigenvalues(jnp.where(ok, matrix, jnp.eye(matrix.shape[0])))
        fastest = jnp.argmax(roots.real)
        margin = _margin(point) if _is_expanded(scene.structure) else jnp.nan
        results = roots.real[fastest], jnp.abs(roots.imag[fastest]) / (2 * jnp.pi), margin
        return *(jnp.where(ok, r, jnp.nan) for r in results), jnp.min(forces)

    return jax.lax.map(lambda chunk: jax.vmap(at)(*chunk), tuple(columns))


def _margin(scene: Scene):
    """The smallest Hurwitz determinant of sliding."""
    _, normal_force = steady_sliding(scene, scene.load.final)
    coefficients = characteristic_polynomial(*steady_matrices(scene, normal_force), time_scale(scene.structure))
    return jnp.min(jnp.stack(hurwitz_determinants(coefficients)))


def _is_expanded(structure: Structure) -> bool:
    """Whether the characteristic polynomial is written out."""
    return len(structure.contacts) == 1 and structure.size - 1 <= LARGEST_EXPANDED


def _slides(scene: Scene, normal_forces):
    """Whether there is steady sliding, by its normal forces (N)."""
    if scene.friction.constant:
        # With constant friction the sliding motion is linear and the same about any state.
        normal_forces = jnp.where(jnp.isfinite(normal_forces), normal_forces, 0.0)
    return jnp.all(normal_forces >= 0) & jnp.all(jnp.abs(scene.belt_speed) > 0)
