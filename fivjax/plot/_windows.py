"""Time windows of runs, their ledgers and legends, for the pictures of energy."""

from collections.abc import Iterator, Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..foundation.digits import apart
from ..simulation.energy import Energy
from ..simulation.trajectory import Trajectory
from .contact_status import shade_status
from .style import BLUE, GREEN, ORANGE, PURPLE, check_run

Window = tuple[float, float]

STYLES = [(BLUE, "-"), (ORANGE, "--"), (GREEN, "-."), (PURPLE, ":")]


def shade(axes: Axes, run: Trajectory, part: slice) -> dict:
    """`shade_status` over a part of a run; legend entries by name."""
    shown = Trajectory(**{**vars(run), "t": run.t[part], "status": run.status[part], "energy": None})
    return {handle.get_label(): handle for handle in shade_status(axes, shown)}


def windows_of(windows) -> list[Window]:
    """The windows of a list, or of an array; a single pair is one."""
    windows = list(windows) if isinstance(windows, Iterator) else windows
    pairs = _numbers(windows)
    if not pairs.size:
        raise ValueError("Argument `windows` must be a list of windows, such as [(0.1, 0.2)], but is empty.")
    if pairs.ndim not in (1, 2) or pairs.shape[-1] != 2 or not np.all(pairs[..., 0] < pairs[..., 1]):
        raise ValueError(
            "Argument `windows` must be a list of windows, each a start and a later end, such as [(0.1, 0.2)], but is "
            f"{windows!r}."
        )
    return [(start, end) for start, end in pairs.reshape(-1, 2).tolist()]


def _numbers(value) -> np.ndarray:
    """The numbers of a window, or of several; a single one where they are none."""
    try:
        return np.asarray(value, float)
    except (TypeError, ValueError):
        return np.zeros(1)


def inside(run: Trajectory, window: Window) -> slice:
    """The rows of a run in a window; refused if there are fewer than two."""
    check_run(run)
    pair = _numbers(window)
    if pair.shape != (2,) or not pair[0] <= pair[1]:
        raise ValueError(f"Argument `window` must be a start and a later end, such as (0.1, 0.2), but is {window!r}.")
    start, end = np.searchsorted(run.t, window[0]), np.searchsorted(run.t, window[1], side="right")
    if end - start < 2:
        first, last, begin, stop = apart(*window, run.t[0], run.t[-1])
        raise ValueError(
            f"A window must hold several instants of the run, but {first} to {last} s holds {end - start}; the run goes from "
            f"{begin} to {stop} s."
        )
    return slice(int(start), int(end))


def ledger(run: Trajectory) -> Energy:
    """The ledger of a run; a run without one is refused in a sentence that says how to get it."""
    check_run(run)
    if run.energy is None:
        raise ValueError("This picture needs a run with its ledger; ask for it: `simulate(..., energy=True)`.")
    return run.energy


def styles(runs: Mapping) -> list:
    """A colour and a line style for each run."""
    return [STYLES[i % len(STYLES)] for i in range(len(runs))]


def align_zeros(*pair: Axes) -> None:
    """Put the zeros of two vertical axes at the same height, so that signs can be read from both."""
    limits = [axes.get_ylim() for axes in pair]
    sizes = [max(abs(low), abs(high)) for low, high in limits]
    below = max(max(-low, 0.0) / size for (low, _), size in zip(limits, sizes, strict=True))
    above = max(max(high, 0.0) / size for (_, high), size in zip(limits, sizes, strict=True))
    for axes, size in zip(pair, sizes, strict=True):
        axes.set_ylim(-1.05 * below * size, 1.05 * above * size)


def legend_between(axes: Axes, entries: list) -> None:
    """A legend in one row between a panel and the one above it."""
    axes.legend(
        handles=entries,
        loc="lower right",
        bbox_to_anchor=(1, 1),
        ncols=len(entries),
        frameon=False,
        columnspacing=1.2,
        handlelength=1.6,
        fontsize="small",
    )


def legend_of_figure(figure: Figure, handles: Mapping) -> None:
    """One legend above all panels; none if there are no entries."""
    if handles:
        figure.legend(handles=list(handles.values()), loc="outside upper right", ncols=4, frameon=False)
