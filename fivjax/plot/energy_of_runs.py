"""Power and energy over time: Figs. 7, 11, 12 and 18, and the whole ledger."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from ..simulation.trajectory import Trajectory
from ._windows import Window, align_zeros, inside, ledger, legend_between, legend_of_figure, shade, styles, windows_of
from .style import BLACK, BLUE, GREEN, ORANGE, PURPLE, VERMILION, check_runs, legend_above, new_figure


def mechanical_power(run: Trajectory, windows: Sequence[Window], *, figure: Figure | None = None) -> Figure:
    """Power into the structure, of contact and load minus damping, in several windows (Fig. 7).

    **Raises:** `ValueError` for a run without a ledger, or a window that holds fewer than two of its instants.
    """
    power, windows = ledger(run).power.mechanical, windows_of(windows)
    figure = new_figure(figure, 3.4 * len(windows), 3.4)
    panels = figure.subplots(1, len(windows), sharey=True, squeeze=False)[0]
    handles = {}
    for axes, window in zip(panels, windows, strict=True):
        part = inside(run, window)
        axes.axhline(0, color="0.7", lw=0.8)
        axes.plot(run.t[part], power[part], color=BLUE, lw=1.2)
        handles |= shade(axes, run, part)
        axes.set(xlabel="time (s)", xlim=window)
    panels[0].set_ylabel("mechanical power (W)")
    legend_of_figure(figure, handles)
    return figure


def mechanical_energy(
    runs: Trajectory | Mapping[str, Trajectory], windows: Sequence[Window] = (), *, figure: Figure | None = None
) -> Figure:
    """Kinetic and elastic energy over time, of one run or of several by label (Fig. 12), or in several windows (Fig. 11).

    **Raises:** `ValueError` for a run without a ledger, or a window that holds fewer than two of its instants.
    """
    runs = dict(runs) if isinstance(runs, Mapping) else {"": runs}
    check_runs(runs)
    longest = max(runs.values(), key=lambda run: run.t[-1])
    whole = isinstance(windows, tuple | list) and not windows
    windows = [(float(longest.t[0]), float(longest.t[-1]))] if whole else windows_of(windows)
    figure = new_figure(figure, 2.2 + 3.6 * len(windows), 3.4)
    panels = figure.subplots(1, len(windows), sharey=True, squeeze=False)[0]
    for axes, window in zip(panels, windows, strict=True):
        for (name, run), (colour, line) in zip(runs.items(), styles(runs), strict=True):
            part = inside(run, window)
            axes.plot(run.t[part], ledger(run).mechanical[part], color=colour, ls=line, lw=0.9, label=name)
        axes.set(xlabel="time (s)", xlim=window, ylim=(0, None))
    panels[0].set_ylabel("mechanical energy (J)")
    if any(runs):
        legend_above(panels[-1], columns=len(runs))
    return figure


def slip_reversal(
    runs: Mapping[str, Trajectory], windows: Mapping[str, Window], *, figure: Figure | None = None
) -> Figure:
    """Tangential velocity of several runs, and for each a window with slip velocity and friction force (Fig. 18).

    **Raises:** `ValueError` for a window that holds fewer than two of a run's instants.
    """
    check_runs(runs, windows)
    figure = new_figure(figure, 8.0, 2.4 + 2.2 * len(runs))
    whole, *panels = figure.subplots(1 + len(runs), 1)
    # The larger motion first, so that it does not hide the smaller.
    drawn = sorted(zip(runs.items(), styles(runs), strict=True), key=lambda item: -_peak(item[0][1]))
    for (name, run), (colour, _) in drawn:
        whole.plot(run.t, np.asarray(run.velocity)[:, run.scene.structure.tangential], color=colour, lw=0.6, label=name)
    longest = max(run.t[-1] for run in runs.values())
    whole.set(xlabel="time (s)", ylabel="tangential\nvelocity (m/s)", xlim=(0, longest))
    for line in legend_above(whole, columns=len(runs)).get_lines():
        line.set_linewidth(3)
    for axes, (name, run) in zip(panels, runs.items(), strict=True):
        part = inside(run, windows[name])
        velocity = np.asarray(run.velocity)[part, run.scene.structure.tangential]
        axes.axhline(0, color="0.7", lw=0.8)
        lines = axes.plot(run.t[part], velocity, color=BLUE, lw=1.2, label="velocity")
        lines += axes.plot(
            run.t[part], run.slip_velocity[part], color=BLACK, ls="--", lw=1.2, label="relative to the belt"
        )
        forces = axes.twinx()
        lines += forces.plot(
            run.t[part], run.friction_force[part], color=VERMILION, ls=":", lw=1.6, label="friction force"
        )
        align_zeros(axes, forces)
        handles = shade(axes, run, part)
        axes.set(ylabel="velocity (m/s)", xlim=windows[name])
        axes.set_title(name, loc="left", fontsize="medium")
        forces.set_ylabel("friction force (N)", color=VERMILION)
        if axes is panels[0]:
            legend_between(axes, [*lines, *handles.values()])
    panels[-1].set_xlabel("time (s)")
    return figure


def balance(run: Trajectory, *, figure: Figure | None = None) -> Figure:
    """The work of every line of the ledger since the start, with the mechanical energy; below, the residual of the balance.

    **Raises:** `ValueError` for a run without a ledger.

    **Example:**

        >>> figure = fj.plot.energy.balance(run)
    """
    energy = ledger(run)
    figure = new_figure(figure, 8.0, 5.4)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    lines = {
        "mechanical energy": (energy.mechanical, BLACK, "-"),
        "contact, sliding": (energy.work.slide, BLUE, "-"),
        "contact, sticking": (energy.work.stick, ORANGE, "--"),
        "damping": (-energy.work.damping, VERMILION, "-."),
        "load": (energy.work.load, GREEN, ":"),
        "impacts": (-energy.impact, PURPLE, (0, (5, 1, 1, 1, 1, 1))),
    }
    for name, (line, colour, style) in lines.items():
        upper.plot(run.t, line, color=colour, ls=style, lw=1.2, label=name)
    upper.set_ylabel("energy into the structure (J)")
    legend_above(upper, columns=3)
    lower.plot(run.t, energy.residual, color=BLACK, lw=0.8)
    lower.set(xlabel="time (s)", ylabel="residual (J)", xlim=(run.t[0], run.t[-1]))
    return figure


def _peak(run: Trajectory) -> float:
    return float(np.nanmax(np.abs(np.asarray(run.velocity)[:, run.scene.structure.tangential])))
