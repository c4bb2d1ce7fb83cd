"""Pictures of energy, in the manner of Figs. 7, 11–16 and 18; results in, a matplotlib `Figure` out, nothing computed.

Runs come from `simulate(..., energy=True)`, cycles from `energy_per_cycle(run)`. A window is a pair of instants in s. What
matters is told by line style or hatching as well as by colour.
"""

from collections.abc import Mapping, Sequence

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ..simulation.energy import Energy
from ..simulation.trajectory import Trajectory
from .results import BLACK, BLUE, GREEN, ORANGE, PURPLE, STATUS_NAMES, VERMILION, shade_status

Window = tuple[float, float]

PER_CYCLE = {"contact_work": "energy from the contact", "energy_gain": "energy gained"}
STYLES = [(BLUE, "-"), (ORANGE, "--"), (GREEN, "-."), (PURPLE, ":")]


def mechanical_power(run: Trajectory, windows: Sequence[Window], *, figure: Figure | None = None) -> Figure:
    """Power that the structure takes up, from contact and load less damping, in several windows (Fig. 7).

    **Raises:** `ValueError` for a run without a ledger, or a window that holds none of its instants.
    """
    power = _ledger(run).power.mechanical
    figure = figure or Figure(figsize=(3.4 * len(windows), 3.4), layout="constrained")
    panels = figure.subplots(1, len(windows), sharey=True, squeeze=False)[0]
    handles = {}
    for axes, window in zip(panels, windows, strict=True):
        part = _inside(run, window)
        axes.axhline(0, color="0.7", lw=0.8)
        axes.plot(run.t[part], power[part], color=BLUE, lw=1.2)
        handles |= _shade(axes, run, part)
        axes.set(xlabel="time (s)", xlim=window)
    panels[0].set_ylabel("mechanical power (W)")
    _legend_above(figure, handles)
    return figure


def mechanical_energy(
    runs: Trajectory | Mapping[str, Trajectory], windows: Sequence[Window] = (), *, figure: Figure | None = None
) -> Figure:
    """Kinetic and elastic energy over time, of one run or of several by label (Fig. 12), or in several windows (Fig. 11).

    **Raises:** `ValueError` for a run without a ledger, or a window that holds none of its instants.
    """
    runs = runs if isinstance(runs, Mapping) else {"": runs}
    longest = max(runs.values(), key=lambda run: run.t[-1])
    windows = windows or [(float(longest.t[0]), float(longest.t[-1]))]
    figure = figure or Figure(figsize=(2.2 + 3.6 * len(windows), 3.4), layout="constrained")
    panels = figure.subplots(1, len(windows), sharey=True, squeeze=False)[0]
    for axes, window in zip(panels, windows, strict=True):
        for (name, run), (colour, line) in zip(runs.items(), _styles(runs), strict=True):
            part = _inside(run, window)
            axes.plot(run.t[part], _ledger(run).mechanical[part], color=colour, ls=line, lw=0.9, label=name)
        axes.set(xlabel="time (s)", xlim=window, ylim=(0, None))
    panels[0].set_ylabel("mechanical energy (J)")
    if any(runs):
        panels[-1].legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=len(runs), frameon=False)
    return figure


def contact_exchange(run: Trajectory, cycles: xr.Dataset, window: Window, *, figure: Figure | None = None) -> Figure:
    """Tangential displacement and status above; power at the contact and what it sums to in each cycle below (Fig. 13).

    **Raises:** `ValueError` for a run without a ledger, or a window that holds none of its instants.
    """
    figure = figure or Figure(figsize=(8.0, 4.8), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True)
    handles = _displacement(upper, run, window)
    handles |= _exchange(lower, run, cycles, window, "contact_work")
    upper.set_xlim(window)
    lower.set_xlabel("time (s)")
    _legend_above(figure, handles)
    return figure


def detachments(
    runs: Mapping[str, Trajectory],
    cycles: Mapping[str, xr.Dataset],
    window: Window,
    overview: Window | None = None,
    *,
    figure: Figure | None = None,
) -> Figure:
    """Displacement and status of several runs in one window, and how long each cycle was detached (Fig. 14).

    The latter over the whole runs, unless an `overview` is given.

    **Raises:** `ValueError` for a run without a ledger, or a window that holds none of its instants.
    """
    figure = figure or Figure(figsize=(4.2 * len(runs), 5.4), layout="constrained")
    grid = figure.add_gridspec(2, len(runs), height_ratios=(1, 1))
    below = figure.add_subplot(grid[1, :])
    handles: dict = {}
    first = None
    for column, ((name, run), (colour, line)) in enumerate(zip(runs.items(), _styles(runs), strict=True)):
        axes = figure.add_subplot(grid[0, column], sharey=first)
        first = first or axes
        handles |= _displacement(axes, run, window)
        axes.set(xlabel="time (s)", xlim=window, title=name)
        own = cycles[name]
        below.plot(
            own["cycle_start"], 1e3 * own["detach_time"], color=colour, ls=line, marker="o", ms=2.5, lw=0.9, label=name
        )
    below.axvspan(*window, color="0.92", zorder=0)
    below.set(xlabel="time (s)", ylabel="detached per cycle (ms)", ylim=(0, None))
    below.set_xlim(overview)
    below.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=len(runs), frameon=False)
    _legend_above(figure, handles)
    return figure


def growth(run: Trajectory, cycles: xr.Dataset, window: Window, *, figure: Figure | None = None) -> Figure:
    """Tangential acceleration and status of a whole run; below, a window of it (Figs. 15, 16).

    There: velocity, contact power, and by how much mechanical energy grew over each cycle, which says what is to come.

    **Raises:** `ValueError` for a run without a ledger, or a window that holds none of its instants.
    """
    figure = figure or Figure(figsize=(8.0, 7.2), layout="constrained")
    whole, strip, middle, lower = figure.subplots(4, 1, height_ratios=(2, 0.7, 1.6, 1.6))
    tangential = run.scene.structure.tangential
    whole.plot(run.t, np.asarray(run.acceleration)[:, tangential], color=BLUE, lw=0.6)
    whole.axvspan(*window, color="0.85", zorder=0)
    whole.set(ylabel="tangential\nacceleration (m/s²)", xlim=(run.t[0], run.t[-1]))
    whole.tick_params(labelbottom=False)
    strip.plot(run.t, run.status, ".", color=VERMILION, ms=1.0, rasterized=True)
    strip.set(xlabel="time (s)", xlim=(run.t[0], run.t[-1]), ylim=(-0.5, 2.5))
    strip.set_yticks(list(STATUS_NAMES), list(STATUS_NAMES.values()))
    part = _inside(run, window)
    middle.plot(run.t[part], np.asarray(run.velocity)[part, tangential], color=BLUE, lw=1.2)
    middle.axhline(float(run.scene.belt_speed), color=BLACK, ls="--", lw=0.9)
    handles = {"belt speed": Line2D([], [], color=BLACK, ls="--", label="belt speed")}
    handles |= _shade(middle, run, part)
    middle.set(ylabel="tangential\nvelocity (m/s)", xlim=window)
    middle.tick_params(labelbottom=False)
    handles |= _exchange(lower, run, cycles, window, "energy_gain")
    lower.set(xlabel="time (s)", xlim=window)
    _legend_over(middle, list(handles.values()))
    return figure


def slip_reversal(
    runs: Mapping[str, Trajectory], windows: Mapping[str, Window], *, figure: Figure | None = None
) -> Figure:
    """Tangential velocity of several runs, and for each a window with slip velocity and friction force (Fig. 18).

    **Raises:** `ValueError` for a window that holds none of a run's instants.
    """
    figure = figure or Figure(figsize=(8.0, 2.4 + 2.2 * len(runs)), layout="constrained")
    whole, *panels = figure.subplots(1 + len(runs), 1)
    # The larger motion first, so that it does not hide the smaller.
    drawn = sorted(zip(runs.items(), _styles(runs), strict=True), key=lambda item: -_peak(item[0][1]))
    for (name, run), (colour, _) in drawn:
        whole.plot(run.t, np.asarray(run.velocity)[:, run.scene.structure.tangential], color=colour, lw=0.6, label=name)
    longest = max(run.t[-1] for run in runs.values())
    whole.set(xlabel="time (s)", ylabel="tangential\nvelocity (m/s)", xlim=(0, longest))
    for line in whole.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=len(runs), frameon=False).get_lines():
        line.set_linewidth(3)
    for axes, (name, run) in zip(panels, runs.items(), strict=True):
        part = _inside(run, windows[name])
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
        _align_zeros(axes, forces)
        handles = _shade(axes, run, part)
        axes.set(ylabel="velocity (m/s)", xlim=windows[name])
        axes.set_title(name, loc="left", fontsize="medium")
        forces.set_ylabel("friction force (N)", color=VERMILION)
        if axes is panels[0]:
            _legend_over(axes, [*lines, *handles.values()])
    panels[-1].set_xlabel("time (s)")
    return figure


def balance(run: Trajectory, *, figure: Figure | None = None) -> Figure:
    """Every line of the ledger, cumulated, with the mechanical energy; below, the residual of the balance.

    **Raises:** `ValueError` for a run without a ledger.
    """
    energy = _ledger(run)
    figure = figure or Figure(figsize=(8.0, 5.4), layout="constrained")
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
    upper.legend(loc="lower right", bbox_to_anchor=(1, 1), frameon=False, ncols=3)
    lower.plot(run.t, energy.residual, color=BLACK, lw=0.8)
    lower.set(xlabel="time (s)", ylabel="residual (J)", xlim=(run.t[0], run.t[-1]))
    return figure


def per_cycle(cycles: xr.Dataset, *, figure: Figure | None = None) -> Figure:
    """Energy over each cycle by line of the ledger, and how long each cycle stuck and was detached."""
    figure = figure or Figure(figsize=(8.0, 5.0), layout="constrained")
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
    upper.legend(loc="lower right", bbox_to_anchor=(1, 1), frameon=False, ncols=4)
    for name, label, colour, style in (
        ("stick_time", "sticking", ORANGE, "-"),
        ("detach_time", "detached", BLUE, "--"),
    ):
        lower.plot(start, 1e3 * cycles[name], color=colour, ls=style, lw=1.2, label=label)
    lower.set(xlabel="time (s)", ylabel="per cycle (ms)", ylim=(0, None))
    lower.legend(loc="lower right", bbox_to_anchor=(1, 1), frameon=False, ncols=2)
    return figure


def _displacement(axes: Axes, run: Trajectory, window: Window) -> dict:
    part = _inside(run, window)
    tangential = run.scene.structure.tangential
    axes.plot(run.t[part], 1e3 * np.asarray(run.displacement)[part, tangential], color=BLUE, lw=1.2)
    axes.set_ylabel("tangential\ndisplacement (mm)")
    return _shade(axes, run, part)


def _exchange(axes: Axes, run: Trajectory, cycles: xr.Dataset, window: Window, name: str) -> dict:
    """Power at the contact, and on an axis of its own a line of the ledger over each whole cycle."""
    part = _inside(run, window)
    axes.axhline(0, color="0.7", lw=0.8)
    (power,) = axes.plot(
        run.t[part], _ledger(run).power.contact[part], color=GREEN, lw=1.2, label="power at the contact"
    )
    axes.set_ylabel("contact power (W)", color=GREEN)
    sums = axes.twinx()
    start, end = cycles["cycle_start"].values, cycles["cycle_end"].values
    seen = (end > window[0]) & (start < window[1])
    energy = 1e3 * cycles[name].values[seen]
    level = sums.hlines(energy, start[seen], end[seen], color=BLACK, lw=2.0, label=PER_CYCLE[name])
    sums.set_ylabel(f"{PER_CYCLE[name]}\nper cycle (mJ)")
    _align_zeros(axes, sums)
    _shade(axes, run, part)
    return {"power": power, "level": level}


def _align_zeros(*pair: Axes) -> None:
    """Put the zeros of two vertical axes at one height, so that signs can be read off both."""
    limits = [axes.get_ylim() for axes in pair]
    spans = [max(abs(low), abs(high)) for low, high in limits]
    below = max(max(-low, 0.0) / span for (low, _), span in zip(limits, spans, strict=True))
    above = max(max(high, 0.0) / span for (_, high), span in zip(limits, spans, strict=True))
    for axes, span in zip(pair, spans, strict=True):
        axes.set_ylim(-1.05 * below * span, 1.05 * above * span)


def _shade(axes: Axes, run: Trajectory, part: slice) -> dict:
    """`shade_status` over a part of a run; legend entries by name."""
    shown = Trajectory(**{**vars(run), "t": run.t[part], "status": run.status[part], "energy": None})
    return {handle.get_label(): handle for handle in shade_status(axes, shown)}


def _inside(run: Trajectory, window: Window) -> slice:
    start, end = np.searchsorted(run.t, window[0]), np.searchsorted(run.t, window[1], side="right")
    if end - start < 2:
        raise ValueError(
            f"A window must hold several instants of the run, but {window[0]:g} to {window[1]:g} s holds {end - start}; "
            f"the run goes from {run.t[0]:g} to {run.t[-1]:g} s."
        )
    return slice(int(start), int(end))


def _ledger(run: Trajectory) -> Energy:
    if run.energy is None:
        raise ValueError("This picture needs a run with its ledger; ask for it: `simulate(..., energy=True)`.")
    return run.energy


def _styles(runs: Mapping) -> list:
    return [STYLES[i % len(STYLES)] for i in range(len(runs))]


def _peak(run: Trajectory) -> float:
    return float(np.nanmax(np.abs(np.asarray(run.velocity)[:, run.scene.structure.tangential])))


def _legend_over(axes: Axes, entries: list) -> None:
    """One row of entries between a panel and the one above it."""
    axes.legend(
        handles=entries,
        loc="lower right",
        bbox_to_anchor=(1, 1),
        ncols=len(entries),
        frameon=False,
        columnspacing=1.2,
        handlelength=1.6,
    )


def _legend_above(figure: Figure, handles: Mapping) -> None:
    if handles:
        figure.legend(handles=list(handles.values()), loc="outside upper right", ncols=4, frameon=False)
