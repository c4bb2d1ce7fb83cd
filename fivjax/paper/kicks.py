"""Section 4.1: a kick decides between sliding and the limit cycle (Figs. 8 to 10)."""

import numpy as np
import xarray as xr

import fivjax as fj

from . import pictures
from . import scenes as paper
from .findings import Made, given, number, statement
from .measures import Window, peak
from .runs import Runs, energy_of


def critical(mu, belt_speed, p_range: Window, p_step: float) -> xr.Dataset:
    """Critical kicks for Fig. 10 and Table 2, over the same two axes, so that they share compiled programs."""
    return fj.critical_perturbation(
        paper.scene(), mu=mu, belt_speed=belt_speed, p_range=p_range, p_step=p_step, tolerance=1e-5, progress=False
    )


def figure_8(runs: Runs) -> Made:
    run = runs("a kick")
    loud, quiet = peak(run, 0.5), peak(run, float(run.t[-1]) - 0.5)
    findings = (
        given("Section 4.1", "duration of the kick", "0.1 s"),
        given("Section 4.1", "load before and after", "100 N"),
        statement(
            "Fig. 8",
            "kick below the critical one (here p = 1.1)",
            "an oscillation that the system damps",
            f"from {loud:.0f} to {quiet:.1f} m/s² in 11.5 s; {int(energy_of(run).ledger.events[-1])} contact events",
            quiet < 0.1 * loud,
            why="the paper prints no p for this figure; 1.1 is one that dies out. The paper kicks after 40 s of quiet sliding, "
            "which is an exact fixed point: here the wait is left out and the kick comes at 0.5 s",
        ),
    )
    caption = "Fig. 8. The kick (Eq. 14) and the answer, p = 1.1, μ = 0.227, 3 m/s."
    return Made(caption, fj.plot.perturbation(run, zoom=0.4), runs.data("a kick", cycles=False), findings)


def figure_9(runs: Runs) -> Made:
    over, under = runs("p = 1.2"), runs("p = 1.19")
    ends = [peak(run, 11.0) for run in (over, under)]
    begins = peak(under, 0.0)
    findings = (
        statement("Fig. 9 (blue)", "p = 1.2", "limit cycle", f"{ends[0]:.0f} m/s² after 11 s", ends[0] > 1000),
        statement(
            "Fig. 9 (yellow)",
            "p = 1.19",
            "returns to stable sliding",
            f"{begins:.0f} m/s² at most, {ends[1]:.0f} m/s² after 11 s and falling",
            ends[1] < 0.1 * begins,
        ),
    )
    caption = (
        "Fig. 9. Tangential acceleration after kicks of p = 1.2 and p = 1.19, μ = 0.227, 3 m/s; time from the kick."
    )
    picture = pictures.overlaid({"p = 1.2": over, "p = 1.19": under})
    return Made(caption, picture, runs.data("p = 1.2", "p = 1.19", cycles=False), findings)


def figure_10(runs: Runs) -> Made:
    limit = float(fj.cea.critical_friction(paper.scene().structure))
    mu = np.append(np.linspace(0.1, 0.228, 17), 0.235)
    data = critical(mu, [3.0], (1.0, 3.0), 0.025).isel(belt_speed=0).assign_attrs(mu_crit=limit)
    p_crit = data["p_crit"].values
    stable = mu < limit
    coupling = float(fj.cea.coalescence(paper.scene().structure).mu)
    findings = (
        statement(
            "Fig. 10",
            "critical p over μ",
            "grows as the friction falls",
            f"{p_crit[stable][-1]:.3f} at μ = {mu[stable][-1]:g} to {p_crit[0]:.3f} at μ = {mu[0]:g}",
            np.all(np.diff(p_crit[stable]) < 0),
            why="the axes of Fig. 10 are not in the text; the range of μ is chosen here",
        ),
        statement(
            "Section 4.1",
            "below μ_coupling",
            "mode coupling can still be induced",
            f"at {np.isfinite(p_crit[mu < coupling]).sum()} of {(mu < coupling).sum()} values of μ below {coupling:.4f}",
            np.all(np.isfinite(p_crit[mu < coupling])),
        ),
        number(
            "Section 4.1",
            "p_crit beyond μ_crit (here μ = 0.235)",
            "1",
            float(p_crit[-1]),
            why="sliding is unstable there by linear theory, and every kick above 1 that is tried ends on the limit cycle",
        ),
    )
    caption = "Fig. 10. Critical perturbation over the friction coefficient, 3 m/s, 100 N."
    return Made(caption, fj.plot.critical(data), data, findings)
