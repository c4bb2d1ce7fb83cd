"""How the critical friction changes with each parameter of the structure."""

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from ..foundation import arguments
from ..foundation.precision import in_double_precision
from ..foundation.quantities import quantity_of
from ..io.datasets import labelled
from ..model.structure import Structure
from .critical import critical_friction, stability_limit
from .gradients import by_numpy_if_small
from .outcomes import Mechanism, StabilityOutcome
from .system import as_scene, checked_direction

if TYPE_CHECKING:
    import xarray as xr

UNITS = {"mass": "kg", "damping": "N s/m", "stiffness": "N/m"}


class Sensitivity(Mapping):
    r"""How μ_crit changes with each parameter: `result["k1"]` is dμ_crit/dk1, a float in SI units.

    - `mu_crit`: the critical friction.
    - `plain`, `normalised`: dictionaries by name: dμ_crit/dp, and (p/μ_crit) dμ_crit/dp, the change of μ_crit in percent per
      percent of p. NaN where there is no derivative.
    - `dataset`: both, with units, for plots and files.
    """

    def __init__(self, dataset: "xr.Dataset"):
        self.dataset = dataset
        names = [str(name) for name in dataset["parameter"].values]
        self.mu_crit = float(dataset["mu_crit"])
        self.plain = dict(zip(names, dataset["sensitivity"].values.tolist(), strict=True))
        self.normalised = dict(zip(names, dataset["normalised"].values.tolist(), strict=True))

    def __getitem__(self, name: str) -> float:
        if name not in self.plain:
            raise KeyError(f"There is no parameter {name!r}.{arguments.did_you_mean(name, self.plain)}")
        return self.plain[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.plain)

    def __len__(self) -> int:
        return len(self.plain)

    def __repr__(self) -> str:
        rows = [f"  {name:<16}{self.plain[name]:>14.6g}{self.normalised[name]:>12.4f}" for name in self]
        return "\n".join([f"mu_crit = {self.mu_crit:.10g}", f"  {'parameter':<16}{'plain':>14}{'% per %':>12}", *rows])


@in_double_precision
def sensitivity(structure: Structure, *, direction: int = 1) -> Sensitivity:
    r"""dμ_crit/d(each physical parameter), by name, plain and in percent per percent.

    The parameters are those of the function that built the structure (seven for `belt_oscillator`). A structure given
    as matrices has its entries instead, `stiffness[0,1]` and so on, the two of a symmetric pair moved together.

    The derivative is implicit (see `critical_friction`). For an undamped structure there is none with respect to
    damping: NaN.

    **Raises:** `ValueError` for a structure that is never or always unstable: there is nothing to differentiate.

    **Example:**

        >>> found = fj.cea.sensitivity(structure)
    """
    import xarray as xr

    arguments.known("structure", structure)
    direction = checked_direction(direction)
    limit = stability_limit(structure, direction=direction)
    if limit.outcome is not StabilityOutcome.FOUND:
        raise ValueError(
            f"There is no critical friction to differentiate: the structure is {limit.outcome.value}. Look at "
            f"`cea.stability_limit(structure).outcome` first."
        )
    values, _ = _named_parameters(structure)
    slopes, damping_slopes = _slopes(structure, direction)
    plain = {name: float(slopes[name]) for name in values}
    if limit.mechanism is Mechanism.COALESCENCE:
        for name, change in damping_slopes.items():
            if np.any(np.asarray(change) != 0):
                plain[name] = np.nan
    mu_crit = float(limit.mu)
    numbers = {name: float(value) for name, value in values.items()}
    units = [(quantity_of(name) or ("", UNITS.get(name.split("[")[0], "?")))[1] for name in values]
    dataset = xr.Dataset(
        {
            "sensitivity": ("parameter", np.array(list(plain.values())), {"long_name": "d mu_crit / d parameter"}),
            "normalised": (
                "parameter",
                np.array([numbers[name] * slope / mu_crit for name, slope in plain.items()]),
                {"long_name": "percent of mu_crit per percent of the parameter", "units": "1"},
            ),
            "value": ("parameter", np.array(list(numbers.values())), {"long_name": "value of the parameter"}),
            "unit": ("parameter", units, {"long_name": "unit of the parameter"}),
            "mu_crit": ((), mu_crit, {"long_name": "critical friction", "units": "1"}),
        },
        coords={"parameter": list(plain)},
    )
    scene = as_scene(structure, mu_crit, direction)
    return Sensitivity(labelled(dataset, scene, analysis="sensitivity of mu_crit", mechanism=limit.mechanism.value))


@by_numpy_if_small
def _slopes(structure: Structure, direction):
    """dμ_crit/dp and dC/dp by name of parameter."""
    values, build = _named_parameters(structure)
    limit = jax.grad(lambda parameters: critical_friction(build(parameters), direction=direction))(values)
    return limit, jax.jacfwd(lambda parameters: build(parameters).damping)(values)


def _named_parameters(structure: Structure):
    if structure.parameters:
        return dict(structure.parameters), lambda parameters: structure.replace(**parameters)
    rows, columns = np.triu_indices(structure.size)
    values = {
        f"{name}[{i},{j}]": getattr(structure, name)[i, j] for name in UNITS for i, j in zip(rows, columns, strict=True)
    }

    def build(parameters):
        matrices = {}
        for name in UNITS:
            entries = jnp.stack([parameters[f"{name}[{i},{j}]"] for i, j in zip(rows, columns, strict=True)])
            upper = jnp.zeros((structure.size, structure.size)).at[rows, columns].set(entries)
            matrices[name] = jnp.where(np.tri(structure.size, dtype=bool).T, upper, upper.T)
        return Structure(
            **matrices,
            load_direction=structure.load_direction,
            contacts=structure.contacts,
        )

    return values, build
