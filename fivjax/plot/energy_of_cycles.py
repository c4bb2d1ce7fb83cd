"""Energy cycle by cycle: Figs. 13 to 16."""

from collections.abc import Mapping

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ..foundation import arguments
from ..simulation.trajectory import Trajectory
from ._windows import Window, align_zeros, inside, ledger, legend_between, legend_of_figure, shade, styles
from .contact_status import STATUS_NAMES
from .style import (
    BLACK,
    BLUE,
    GREEN,
    ORANGE,
    PURPLE,
    VERMILION,
    check_dataset,
    check_run,
    check_runs,
    legend_above,
    new_figure,
)

PER_CYCLE = {"contact_work": "energy from the contact", "energy_gain": "energy gained"}


def contact_exchange(run: Trajectory, cycles: xr.Dataset, window: Window, *, figure: Figure | None = None) -> Figure:
    """Tangential displacement and status above; power at the contact and its work in each cycle below (Fig. 13).

    **Raises:** `ValueError` for a run without a ledger, or a window that holds fewer than two of its instants.
    """
    figure = new_figure(figure, 8.0, 4.8)
    upper, lower = figure.subplots(2, 1, sharex=True)
    handles = _displacement(upper, run, window)
    handles |= _exchange(lower, run, cycles, window, "contact_work")
    upper.set_xlim(window)
    lower.set_xlabel("time (s)")
    legend_of_figure(figure, handles)
    return figure


def detachments(
    runs: Mapping[str, Trajectory],
    cycles: Mapping[str, xr.Dataset],
    window: Window | Mapping[str, Window],
    overview: Window | None = None,
    *,
    figure: Figure | None = None,
) -> Figure:
    """Displacement and status of several runs in a window, and the detached time of each cycle (Fig. 14).

    `window` is one for all runs, or a window for each run by label. Detached times are shown over the whole runs, or over
    `overview` if it is given.

    **Raises:** `ValueError` for a run without a ledger, or a window that holds fewer than two of its instants.
    """
    check_runs(runs, cycles, *([window] if isinstance(window, Mapping) else []))
    figure = new_figure(figure, 4.2 * len(runs), 5.4)
    grid = figure.add_gridspec(2, len(runs), height_ratios=(1, 1))
    below = figure.add_subplot(grid[1, :])
    handles: dict = {}
    windows = window if isinstance(window, Mapping) else dict.fromkeys(runs, window)
    first = None
    for column, ((name, run), (colour, line)) in enumerate(zip(runs.items(), styles(runs), strict=True)):
        axes = figure.add_subplot(grid[0, column], sharey=first)
        first = first or axes
        shown = windows[name]
        handles |= _displacement(axes, run, shown)
        axes.set(xlabel="time (s)", xlim=shown, title=name)
        below.axvspan(*shown, color=colour, alpha=0.15, zorder=0, lw=0)
        own = cycles[name]
        below.plot(
            own["cycle_start"], 1e3 * own["detach_time"], color=colour, ls=line, marker="o", ms=2.5, lw=0.9, label=name
        )
    below.set(xlabel="time (s)", ylabel="detached per cycle (ms)", ylim=(0, None))
    below.set_xlim(overview)
    legend_above(below, columns=len(runs))
    legend_of_figure(figure, handles)
    return figure


def growth(
    run: Trajectory,
    cycles: xr.Dataset,
    window: Window,
    per_cycle: str = "energy_gain",
    *,
    figure: Figure | None = None,
) -> Figure:
    """Tangential acceleration and status of a whole run; below, a window of it (Figs. 15, 16).

    The window shows velocity, contact power, and for each cycle the growth of mechanical energy ("energy_gain") or the work of
    the contact ("contact_work").

    **Raises:** `ValueError` for a run without a ledger, or a window that holds fewer than two of its instants.
    """
    check_run(run)
    arguments.one_of("per_cycle", per_cycle, PER_CYCLE)
    part = inside(run, window)
    figure = new_figure(figure, 8.0, 7.2)
    whole, strip, middle, lower = figure.subplots(4, 1, height_ratios=(2, 0.7, 1.6, 1.6))
    tangential = run.scene.structure.tangential
    whole.plot(run.t, np.asarray(run.acceleration)[:, tangential], color=BLUE, lw=0.6)
    whole.axvspan(*window, color="0.85", zorder=0)
    whole.set(ylabel="tangential\nacceleration (m/s²)", xlim=(run.t[0], run.t[-1]))
    whole.tick_params(labelbottom=False)
    strip.plot(run.t, run.status, ".", color=VERMILION, ms=1.0, rasterized=True)
    strip.set(xlabel="time (s)", xlim=(run.t[0], run.t[-1]), ylim=(-0.5, 2.5))
    strip.set_yticks(list(STATUS_NAMES), list(STATUS_NAMES.values()))
    middle.plot(run.t[part], np.asarray(run.velocity)[part, tangential], color=BLUE, lw=1.2)
    middle.axhline(float(run.scene.belt_speed), color=BLACK, ls="--", lw=0.9)
    handles = {"belt speed": Line2D([], [], color=BLACK, ls="--", label="belt speed")}
    handles |= shade(middle, run, part)
    middle.set(ylabel="tangential\nvelocity (m/s)", xlim=window)
    middle.tick_params(labelbottom=False)
    handles |= _exchange(lower, run, cycles, window, per_cycle)
    lower.set(xlabel="time (s)", xlim=window)
    legend_between(middle, list(handles.values()))
    return figure


def per_cycle(cycles: xr.Dataset, *, figure: Figure | None = None) -> Figure:
    """Energy over each cycle by line of the ledger, and the time of sticking and of detachment in each cycle.

    With several contacts, the later they are, the thinner is the line of their times.

    **Raises:** `TypeError` for anything but energies per cycle.
    """
    check_dataset(cycles, ("contact_work", "energy_gain"), "fj.energy_per_cycle(run)", "cycles")
    figure = new_figure(figure, 8.0, 5.0)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    start = cycles["cycle_start"]
    upper.axhline(0, color="0.7", lw=0.8)
    for name, label, sign, colour, style in (
        ("contact_work", "contact", 1, BLUE, "-"),
        ("damping_work", "damping", -1, VERMILION, "-."),
        ("impact_loss", "impacts", -1, PURPLE, ":"),
        ("energy_gain", "gain of mechanical energy", 1, BLACK, "--"),
    ):
        upper.plot(start, sign * cycles[name], color=colour, ls=style, lw=1.2, label=label)
    upper.set_ylabel("energy per cycle (J)")
    legend_above(upper, columns=4)
    for name, label, colour, style in (
        ("stick_time", "sticking", ORANGE, "-"),
        ("detach_time", "detached", BLUE, "--"),
    ):
        times = cycles[name].values
        times = 1e3 * times.reshape(len(start), int(np.prod(times.shape[1:])))
        for contact, own in enumerate(times.T):
            named = label if times.shape[1] == 1 else f"{label}, contact {contact}"
            lower.plot(start, own, color=colour, ls=style, lw=2.4 / (2 + contact), label=named)
    lower.set(xlabel="time (s)", ylabel="per cycle (ms)", ylim=(0, None))
    legend_above(lower, columns=2)
    return figure


def _displacement(axes: Axes, run: Trajectory, window: Window) -> dict:
    part = inside(run, window)
    tangential = run.scene.structure.tangential
    axes.plot(run.t[part], 1e3 * np.asarray(run.displacement)[part, tangential], color=BLUE, lw=1.2)
    axes.set_ylabel("tangential\ndisplacement (mm)")
    return shade(axes, run, part)


def _exchange(axes: Axes, run: Trajectory, cycles: xr.Dataset, window: Window, name: str) -> dict:
    """Power at the contact, and, on a second axis, a line of the ledger for each whole cycle."""
    part = inside(run, window)
    axes.axhline(0, color="0.7", lw=0.8)
    (power,) = axes.plot(
        run.t[part], ledger(run).power.contact[part], color=GREEN, lw=1.2, label="power at the contact"
    )
    axes.set_ylabel("contact power (W)", color=GREEN)
    sums = axes.twinx()
    start, end = cycles["cycle_start"].values, cycles["cycle_end"].values
    seen = (end > window[0]) & (start < window[1])
    energy = 1e3 * cycles[name].values[seen]
    level = sums.hlines(energy, start[seen], end[seen], color=BLACK, lw=2.0, label=PER_CYCLE[name])
    sums.set_ylabel(f"{PER_CYCLE[name]}\nper cycle (mJ)")
    align_zeros(axes, sums)
    shade(axes, run, part)
    return {"power": power, "level": level}
