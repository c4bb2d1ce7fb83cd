"""A limit cycle: phase plane with its contact modes, multipliers beside the unit circle, points of the section."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ..contact import Status
from ..cycles.cycle import LimitCycle
from ..foundation import arguments
from .contact_status import STATUS_NAMES
from .style import BLACK, BLUE, ORANGE, VERMILION, legend_above, new_figure

ROWS = 2000
# Lines differ in their dashes, too: two of one brightness are not told apart in grey.
COLOURS = {Status.STICK: ORANGE, Status.SLIDE: BLUE, Status.DETACH: VERMILION}
STYLES = {
    Status.STICK: {"ls": "-", "lw": 3.0},
    Status.SLIDE: {"ls": "-", "lw": 1.4},
    Status.DETACH: {"ls": "--", "lw": 1.4},
}


def cycle(cycle: LimitCycle, others: LimitCycle | Sequence[LimitCycle] = (), *, figure: Figure | None = None) -> Figure:
    """A limit cycle in the phase plane, coloured by contact mode, and its Floquet multipliers beside the unit circle.

    For a torus, the points of the section are drawn instead of the multipliers. `others` (for instance the saddle cycle) are
    drawn dotted in the same phase plane. With several contacts, the one that moves fastest is shown.

    **Raises:** `TypeError` for anything but a `LimitCycle`.
    """
    others = (others,) if isinstance(others, LimitCycle) else others
    for one in (cycle, *others):
        arguments.instance("cycle", one, LimitCycle, "a limit cycle, such as `fivjax.limit_cycle(scene)`")
    figure = new_figure(figure, 9.6, 4.6)
    plane, right = figure.subplots(1, 2, width_ratios=(3, 2))
    contact = _phase_plane(plane, cycle)
    handles = [
        Line2D([], [], color=COLOURS[status], label=STATUS_NAMES[status], **STYLES[status])
        for status in _statuses(cycle, contact)
    ]
    for other in others:
        run = other.trajectory(ROWS)
        x, v = _tangential(run, contact)
        plane.plot(1e3 * x, v, color=BLACK, ls=":", lw=1.1)
        label = "another cycle" if other.stable else "saddle cycle"
        handles.append(Line2D([], [], color=BLACK, ls=":", label=f"{label}, {other.amplitude:.4g} m/s"))
    plane.set(xlabel="tangential displacement (mm)", ylabel="tangential velocity (m/s)")
    legend_above(plane, handles, columns=3)
    if cycle.kind == "torus":
        _section(right, cycle, contact)
    else:
        _multipliers(right, cycle)
    return figure


def _statuses(cycle: LimitCycle, contact: int) -> list[Status]:
    return sorted({s if isinstance(s := phase.status, Status) else s[contact] for phase in cycle.word})


def _tangential(run, contact: int) -> tuple[np.ndarray, np.ndarray]:
    along = run.scene.structure.tangential_directions[:, contact]
    return np.asarray(run.displacement) @ along, np.asarray(run.velocity) @ along


def _phase_plane(axes: Axes, cycle: LimitCycle) -> int:
    """Draw the cycle. Returns the number of the contact that is shown."""
    # For a torus, long enough for several beats.
    periods = 1 if cycle.kind == "periodic" else 40
    run = cycle.trajectory(ROWS, periods=periods)
    speeds = np.abs(np.asarray(run.velocity) @ run.scene.structure.tangential_directions)
    contact = int(np.argmax(np.max(speeds, axis=0)))
    x, v = _tangential(run, contact)
    status = np.asarray(run.status).reshape(len(x), -1)[:, contact]
    for mode in _statuses(cycle, contact):
        here = status == mode
        # A row belongs to the line segments before and after it.
        shown = here | np.append(False, here[:-1])
        axes.plot(1e3 * np.where(shown, x, np.nan), np.where(shown, v, np.nan), color=COLOURS[mode], **STYLES[mode])
    belt = float(np.broadcast_to(cycle.scene.belt_speed, speeds.shape[1])[contact])
    low, high = axes.get_ylim()
    if low < belt < high:
        axes.axhline(belt, color=BLACK, lw=0.6, ls=":")
    return contact


def _multipliers(axes: Axes, cycle: LimitCycle) -> None:
    angle = np.linspace(0.0, 2 * np.pi, 361)
    axes.plot(np.cos(angle), np.sin(angle), color=BLACK, lw=0.8)
    inside = np.abs(cycle.multipliers) <= 1 + 1e-9
    kinds = ((inside, BLUE, "o", "inside the unit circle, or 1"), (~inside, VERMILION, "s", "outside of it"))
    for chosen, colour, marker, name in kinds:
        if np.any(chosen):
            values = cycle.multipliers[chosen]
            axes.plot(values.real, values.imag, marker, color=colour, ms=6, label=name)
    axes.set(xlabel="Floquet multiplier, real part", ylabel="imaginary part", aspect="equal")
    legend_above(axes, axes.get_legend_handles_labels()[0], columns=2)


def _section(axes: Axes, cycle: LimitCycle, contact: int) -> None:
    structure = cycle.scene.structure
    tangential, normal = structure.tangential_directions[:, contact], structure.normal_directions[:, contact]
    # Upwards a coordinate that is not the contact's own, if there is one, else a normal one: on the section others stand still.
    second = int(np.lexsort((normal != 0, tangential != 0))[0])
    moved = np.flatnonzero(tangential)
    first = structure.coordinates[moved[0]] if len(moved) == 1 else f"tangential displacement of contact {contact}"
    n = structure.size
    axes.plot(1e3 * cycle.points[:, :n] @ tangential, cycle.points[:, n + second], ".", color=BLUE, ms=2)
    axes.set(
        xlabel=f"{first} on the section, from equilibrium (mm)",
        ylabel=f"velocity of {structure.coordinates[second]} (m/s)",
    )
