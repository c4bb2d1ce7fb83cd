"""Section 2: parameters, friction laws, complex eigenvalue analysis (Table 1, Figs. 2 and 3)."""

import numpy as np
import xarray as xr

import fivjax as fj

from . import pictures
from . import scenes as paper
from .findings import Made, given, number, statement
from .runs import Runs


def table_1(runs: Runs) -> Made:
    computed = {name: float(value) for name, value in paper.scene().parameters.items()}
    rows = [(what, name, f"{value:g}", unit) for name, (what, value, unit) in paper.TABLE_1.items()]
    data = xr.Dataset(
        {"value": ("parameter", [computed[name] for name in paper.TABLE_1])},
        {"parameter": list(paper.TABLE_1), "unit": ("parameter", [unit for _, _, unit in paper.TABLE_1.values()])},
    )
    findings = tuple(given("Table 1", what, f"{value:g} {unit}") for what, value, unit in paper.TABLE_1.values())
    picture = pictures.table(["parameter", "symbol", "value", "unit"], rows)
    caption = "Table 1. Parameters of the lumped model: what everything else here starts from."
    return Made(caption, picture, data, findings, paper.scene())


def figure_2(runs: Runs) -> Made:
    speed = np.linspace(0, 8, 401)
    laws = {
        "constant, μ = 0.5": paper.CONSTANT,
        "falling, 0.6 to 0.5": paper.BOTH,
        "falling, 0.2 to 0.1": paper.FALLING,
    }
    values = np.array([np.broadcast_to(np.asarray(law(speed)), speed.shape) for law in laws.values()])
    data = xr.Dataset(
        {"friction": (("law", "slip_speed"), values, {"long_name": "friction coefficient", "units": "1"})},
        {"law": list(laws), "slip_speed": ("slip_speed", speed, {"long_name": "slip speed", "units": "m/s"})},
    )
    findings = (
        given("Section 2.1", "decay factor d", "0.5 s/m"),
        given("Section 3.1 (Fig. 2, red)", "constant friction coefficient", "0.5"),
        given("Section 3.2", "static and dynamic friction coefficient", "0.2, 0.1"),
        given("Section 3.3", "static and dynamic friction coefficient", "0.6, 0.5"),
    )
    caption = (
        "Fig. 2. Friction laws: constant (Section 3.1), and falling with slip speed (Eq. 1, Sections 3.2 and 3.3)."
    )
    return Made(caption, pictures.friction_laws(data), data, findings, paper.scene(paper.CONSTANT))


def figure_3(runs: Runs) -> Made:
    data = fj.cea.modes(paper.scene().structure, mu=np.linspace(0, 0.5, 501))
    mu_crit, mu_meet = float(data["mu_crit"]), float(data["mu_coalescence"])
    below = float(data["growth_rate"].sel(mu=slice(0, mu_crit)).max())
    spread = data["growth_rate"].sel(mu=0.5, method="nearest").values
    findings = (
        number(
            "Section 2.3, Fig. 3(a)",
            "μ_coupling",
            "0.22",
            mu_meet,
            why="the undamped modes of Table 1 meet at 0.22636, which rounds to 0.23; the printed digits look cut off rather "
            "than rounded. With damping the modes come close near there without meeting exactly",
        ),
        number("Section 2.3, Fig. 3(b)", "μ_crit", "0.23", mu_crit, why="0.228225 to more digits"),
        number("Section 2.3, Fig. 3(a)", "frequency of the coalescence", "68", float(data["frequency_crit"]), "Hz"),
        statement(
            "Section 2.3",
            "real parts below μ_crit",
            "negative",
            f"at most {below:.3f} 1/s on an axis that ends within 0.001 of the limit",
            below < 0,
        ),
        statement(
            "Section 2.3",
            "real parts beyond the coupling",
            "diverge; one becomes positive",
            f"{spread.min():.2f} and {spread.max():.2f} 1/s at μ = 0.5",
            spread.min() < 0 < spread.max(),
        ),
    )
    caption = "Fig. 3. (a) Natural frequencies and (b) real parts of the modes of steady sliding over friction."
    return Made(caption, pictures.lettered(fj.plot_linear.eigenvalues(data)), data, findings)
