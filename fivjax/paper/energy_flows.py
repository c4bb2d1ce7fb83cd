"""Section 4.2: where the energy of the vibration comes from (Figs. 11 to 14)."""

import numpy as np
import xarray as xr

import fivjax as fj

from . import pictures
from .findings import Made, statement
from .measures import Window, cycles_within, growth_rate, two_cycles
from .runs import Runs, energy_of


def figure_11(runs: Runs) -> Made:
    name = "mode coupling, 3 m/s"
    run, cycles = runs(name), runs.cycles(name)
    start = runs.first(name)
    energy = np.asarray(energy_of(run).mechanical)
    thirds = [energy[(run.t >= t) & (run.t < t + 1)].mean() for t in (3.0, 4.0, 5.0)]
    rate, linear = growth_rate(run, cycles, (0.3 * start, 0.95 * start)), float(fj.cea.growth_rate(run.scene))
    findings = (
        statement(
            "Fig. 11(a)",
            "energy of the vibration during onset",
            "grows exponentially with the vibrations",
            f"with {2 * rate:.2f} 1/s, twice the {rate:.2f} 1/s of the amplitude (linear theory: {2 * linear:.2f})",
            abs(rate / linear - 1) < 0.05,
        ),
        statement(
            "Fig. 11(b)",
            "mean energy at the limit cycle",
            "constant",
            f"{', '.join(f'{x:.4f}' for x in thirds)} J over three seconds in turn",
            np.ptp(thirds) < 0.02 * np.mean(thirds),
        ),
    )
    windows = [(max(0.0, start - 0.5), start + 0.15), (float(run.t[-1]) - 0.3, float(run.t[-1]))]
    caption = "Fig. 11. Mechanical energy during mode coupling (run of Fig. 4): (a) onset, (b) limit cycle."
    picture = pictures.lettered(fj.plot_energy.mechanical_energy(run, windows))
    return Made(caption, picture, runs.data(name), findings)


def figure_12(runs: Runs) -> Made:
    shown = {name: runs(name) for name in ("p = 1.2", "p = 1.19")}
    ends = {name: energy_of(run).mechanical[run.t > 11.0].mean() for name, run in shown.items()}
    rest = float(energy_of(shown["p = 1.19"]).mechanical[0])
    late = [
        energy_of(shown["p = 1.2"]).mechanical[(shown["p = 1.2"].t > t) & (shown["p = 1.2"].t < t + 3)].mean()
        for t in (6, 9)
    ]
    findings = (
        statement(
            "Fig. 12 (blue)",
            "p = 1.2",
            "energy oscillates around a constant mean at the limit cycle",
            f"mean {late[0]:.3f} J over 6–9 s, {late[1]:.3f} J over 9–12 s",
            abs(late[1] / late[0] - 1) < 0.02,
        ),
        statement(
            "Fig. 12 (yellow)",
            "p = 1.19",
            "below the critical value: back to sliding",
            f"mean {ends['p = 1.19']:.4f} J after 11 s; steady sliding has {rest:.4f} J",
            ends["p = 1.19"] < 1.1 * rest,
        ),
    )
    caption = "Fig. 12. Mechanical energy after kicks of p = 1.2 and p = 1.19."
    return Made(caption, fj.plot_energy.mechanical_energy(shown), runs.data(*shown), findings)


def figure_13(runs: Runs) -> Made:
    name = "p = 1.2"
    run, cycles = runs(name), runs.cycles(name)
    window = two_cycles(cycles, runs.first(name, 2) + 0.25)
    inside = (run.t >= window[0]) & (run.t <= window[1])
    detached = inside & (np.asarray(run.status) == 2)
    back = np.mean(np.asarray(run.velocity)[detached, 0] < 0)
    work = cycles["contact_work"].values[cycles_within(cycles, window)]
    findings = (
        statement(
            "Fig. 13",
            "detachment",
            "from the maximum of x2 towards equilibrium, velocity against the belt's",
            f"velocity against the belt's for {back:.0%} of the time detached",
            back > 0.5,
            why="a detachment begins on the way back and may last beyond the turning point" if back < 1 else "",
        ),
        statement(
            "Fig. 13 (green)",
            "power at the contact while detached",
            "none",
            f"{np.abs(energy_of(run).power.contact[detached]).max():g} W",
            np.all(energy_of(run).power.contact[detached] == 0),
        ),
        statement(
            "Fig. 13 (black)",
            "energy from the contact per cycle",
            "positive: the system accumulates energy",
            f"{', '.join(f'{1e3 * w:.1f}' for w in work)} mJ",
            np.all(work > 0),
        ),
    )
    caption = "Fig. 13. Two cycles of growth, p = 1.2, μ = 0.227, 3 m/s: displacement; contact power, energy per cycle."
    return Made(
        caption, fj.plot_energy.contact_exchange(runs.beginning(name), cycles, window), runs.data(name), findings
    )


# The number of cycles with detachment that are compared, from the first on.
FIRST = 10


def first_detachments(cycles: xr.Dataset) -> slice:
    """The first consecutive cycles of a run with detachment."""
    begun = int(np.flatnonzero(cycles["detach_time"].values > 0)[0])
    return slice(begun, begun + FIRST)


def window_of(cycles: xr.Dataset) -> Window:
    """From the start of the first of some cycles to the end of the last, in s."""
    return float(cycles["cycle_start"][0]), float(cycles["cycle_end"][-1])


def listed(values: np.ndarray) -> str:
    """The first, the second and the last of some values."""
    return f"{values[0]:.2f}, {values[1]:.2f} … {values[-1]:.2f}"


def figure_14(runs: Runs) -> Made:
    names = ("p = 1.2", "p = 1.19")
    cycles = {name: runs.cycles(name) for name in names}
    # Compared cycle by cycle from the first with detachment, while the run with the larger kick is not yet on its limit cycle.
    first = {name: first_detachments(cycles[name]) for name in names}
    off = {name: 1e3 * cycles[name]["detach_time"].values[part] for name, part in first.items()}
    windows = {
        name: window_of(cycles[name].isel(cycle=part).isel(cycle=slice(-2, None))) for name, part in first.items()
    }
    size = -cycles["p = 1.2"]["turning_point"].values
    reached = size[first["p = 1.2"]].max() / size[-100:].max()
    findings = (
        statement(
            "Fig. 14",
            "detachments at p = 1.19",
            "shorter than at p = 1.2",
            f"{listed(off['p = 1.19'])} ms in the first {FIRST} cycles that detach; at p = 1.2 {listed(off['p = 1.2'])} ms",
            np.all(off["p = 1.19"] < off["p = 1.2"]),
            why=f"compared while both grow: in these cycles the run of p = 1.2 has swung to {reached:.0%} of its limit cycle",
        ),
    )
    picture = fj.plot_energy.detachments({n: runs(n) for n in names}, cycles, windows, (0.8, 1.8))
    pictures.lettered(picture, picture.axes[1:])
    caption = (
        f"Fig. 14. Detachment after kicks (a) above and (b) below the critical one, in the {FIRST - 1}th and {FIRST}th cycle "
        "that detaches; below, time detached in every cycle."
    )
    return Made(caption, picture, runs.data(*names), findings)
