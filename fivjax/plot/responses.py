"""Trajectories over time and in the phase plane (Figs. 8, 9 and 17)."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ..foundation import arguments
from ..foundation.quantities import QUANTITIES
from ..simulation.trajectory import OF_COORDINATES, Trajectory
from .contact_status import mark_kick, shade_status
from .style import (
    BLACK,
    BLUE,
    GREEN,
    ORANGE,
    PURPLE,
    VERMILION,
    check_run,
    check_runs,
    coordinate_label,
    legend_above,
    new_figure,
    with_unit,
)


def response(
    run: Trajectory, quantity: str = "acceleration", coordinate: int | None = None, *, figure: Figure | None = None
) -> Figure:
    """One coordinate over time, with the contact's status shaded and the kick marked at the top.

    With several contacts, there is a panel for each: its tangential coordinate, with its own status.

    **Arguments:** `run`; `quantity`, "displacement", "velocity" or "acceleration"; `coordinate`, by its number, the
    tangential one unless given. With several contacts, a given coordinate is drawn without status.

    **Raises:** `TypeError` for anything but a trajectory, `ValueError` for another quantity, or no coordinate of the structure.

    **Example:**

        >>> figure = fj.plot.response(run, "velocity")
    """
    check_run(run)
    structure = run.scene.structure
    if coordinate is not None:
        coordinate = arguments.whole_number("coordinate", coordinate, minimum=0)
        if coordinate >= structure.size:
            raise ValueError(f"Argument `coordinate` must be at most {structure.size - 1}, but is {coordinate}.")
    several = len(structure.contacts) > 1
    places = [tangential for tangential, _ in structure.places] if coordinate is None else [coordinate]
    figure = new_figure(figure, 8.0, 3.6 if len(places) == 1 else 1.2 + 1.6 * len(places))
    panels = figure.subplots(len(places), 1, sharex=True, squeeze=False)[:, 0]
    found = {}
    for contact, (axes, place) in enumerate(zip(panels, places, strict=True)):
        values, what = _along(run, quantity, place)
        axes.plot(run.t, values, color=BLACK, lw=0.8)
        handles = [] if several and coordinate is not None else shade_status(axes, run, contact)
        found.update({handle.get_label(): handle for handle in [*handles, *mark_kick(axes, run)]})
        what = f"{what}, {quantity}" if len(places) == 1 else what
        axes.set(ylabel=with_unit(what, QUANTITIES[quantity][1]), xlim=(run.t[0], run.t[-1]))
    panels[-1].set_xlabel("time (s)")
    if found:
        legend_above(panels[0], list(found.values()))
    return figure


def _along(run: Trajectory, quantity: str, place: int | tuple[float, ...]) -> tuple[np.ndarray, str]:
    """A quantity at a coordinate, or along a direction of a contact given by vectors; and what that is called."""
    if isinstance(place, tuple):
        return _of(run, quantity) @ np.array(place), "along the belt"
    return _of(run, quantity)[:, place], coordinate_label(run.scene.structure, place)


def _tangential(run: Trajectory) -> int | tuple[float, ...]:
    """Where the only contact's tangential direction is. Several are refused."""
    structure = run.scene.structure
    return structure.tangential if len(structure.contacts) > 1 else structure.places[0][0]


def phase_plane(
    runs: Trajectory | Mapping[str, Trajectory], last: float = 0.5, *, figure: Figure | None = None
) -> Figure:
    """Tangential velocity over displacement for the `last` seconds of one run or of several by label (Fig. 17).

    With several contacts, there is a panel for each.

    **Example:**

        >>> figure = fj.plot.phase_plane(run)
    """
    if not (isinstance(last, float) and last == np.inf):
        arguments.real_number("last", last, minimum=0)
    runs = dict(runs) if isinstance(runs, Mapping) else {"": runs}
    check_runs(runs)
    count = max(len(run.scene.structure.contacts) for run in runs.values())
    figure = new_figure(figure, 5.6 if count == 1 else 3.6 * count, 4.6)
    panels = figure.subplots(1, count, squeeze=False)[0]
    styles = [(GREEN, "-"), (PURPLE, "--"), (BLUE, "-."), (ORANGE, ":"), (VERMILION, "-"), (BLACK, "--")]
    for (name, run), (colour, line) in zip(runs.items(), styles * (1 + len(runs) // len(styles)), strict=False):
        end = np.asarray(run.t) >= run.t[-1] - last
        along = run.scene.structure.tangential_directions
        x, v = np.asarray(run.displacement)[end] @ along, np.asarray(run.velocity)[end] @ along
        for contact, axes in enumerate(panels[: x.shape[1]]):
            axes.plot(1e3 * x[:, contact], v[:, contact], color=colour, ls=line, lw=0.9, label=name)
    for contact, axes in enumerate(panels):
        axes.set(xlabel="tangential displacement (mm)")
        if count > 1:
            axes.set_title(f"contact {contact}", loc="right", fontsize="medium")
    panels[0].set_ylabel("tangential velocity (m/s)")
    if any(runs):
        # The legend is outside of the plane, because motions may be anywhere in it.
        legend_above(panels[0])
    return figure


def perturbation(run: Trajectory, *, zoom: float | None = None, figure: Figure | None = None) -> Figure:
    """The load's pulse and the tangential acceleration in response (Fig. 8).

    **Arguments:** `run`; `zoom`, a time in s: if given, this much of the run around the kick is shown as well, because the
    shape of a kick is not visible in a long run.

    **Raises:** `TypeError` for anything but a trajectory, `ValueError` for a `zoom` that is not positive.

    **Example:**

        >>> figure = fj.plot.perturbation(run)
    """
    check_run(run)
    if zoom is not None:
        arguments.real_number("zoom", zoom, above=0)
    figure = new_figure(figure, 8.0 if zoom is None else 9.6, 4.8)
    width = (1,) if zoom is None else (2, 3)
    panels = figure.subplots(
        2, len(width), sharex="col", sharey="row", height_ratios=(1, 2), width_ratios=width, squeeze=False
    )
    whole = (float(run.t[0]), float(run.t[-1]))
    raised = np.flatnonzero(run.load != run.load[-1])
    begin = float(run.t[raised[0]]) if len(raised) else whole[0]
    windows = (
        [whole] if zoom is None else [(max(whole[0], begin - 0.2 * zoom), min(whole[1], begin + 0.8 * zoom)), whole]
    )
    acceleration, what = _along(run, "acceleration", _tangential(run))
    for (upper, lower), window in zip(panels.T, windows, strict=True):
        upper.step(run.t, run.load, where="post", color=VERMILION, lw=1.6)
        lower.plot(run.t, acceleration, color=BLUE, lw=0.7)
        mark_kick(lower, run)
        lower.set(xlabel="time (s)", xlim=window)
    # The axis covers the range of the load, not zero, so that a kick of a tenth is visible.
    low, high = float(np.min(run.load)), float(np.max(run.load))
    room = 0.2 * (high - low) or 0.1 * high or 1.0
    panels[0, 0].set(ylabel="load (N)", ylim=(low - room, high + room))
    panels[1, 0].set_ylabel(with_unit(f"{what},\nacceleration", "m/s2"))
    if zoom is not None:
        for upper, name in zip(panels[0], ("around the kick", "whole run"), strict=True):
            upper.set_title(name, loc="right", fontsize="medium")
    return figure


def comparison(
    runs: Mapping[str, Trajectory], quantity: str = "acceleration", *, figure: Figure | None = None
) -> Figure:
    """The tangential response of several runs by label, each in a row of its own, on the same scale (Fig. 9).

    **Example:**

        >>> figure = fj.plot.comparison({"p = 1.2": run})
    """
    runs = dict(runs) if isinstance(runs, Mapping) else runs
    check_runs(runs)
    figure = new_figure(figure, 8.0, 1.2 + 1.9 * len(runs))
    rows = list(figure.subplots(len(runs), 1, sharex=True, sharey=True, squeeze=False)[:, 0])
    for axes, (name, run), colour in zip(rows, runs.items(), [BLUE, ORANGE, GREEN, PURPLE] * len(runs), strict=False):
        values, what = _along(run, quantity, _tangential(run))
        axes.plot(run.t, values, color=colour, lw=0.7)
        handles = [Line2D([], [], color=colour, label=name), *shade_status(axes, run), *mark_kick(axes, run)]
        legend_above(axes, handles, columns=4)
        axes.set_ylabel(with_unit(f"{what},\n{quantity}", QUANTITIES[quantity][1]))
        axes.set_xlim(run.t[0], run.t[-1])
    rows[-1].set_xlabel("time (s)")
    return figure


def _of(run: Trajectory, quantity: str) -> np.ndarray:
    arguments.one_of("quantity", quantity, OF_COORDINATES)
    return np.asarray(getattr(run, quantity))
