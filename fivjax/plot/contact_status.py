"""Marks for the contact's status and for the kick, in pictures over time."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Patch

from ..contact import Status
from ..model.load import Pulse
from ..simulation.trajectory import Trajectory
from .style import ORANGE, SKY, VERMILION

STATUS_COLOURS = {Status.STICK: ORANGE, Status.DETACH: SKY}
STATUS_NAMES = {Status.STICK: "sticking", Status.SLIDE: "sliding", Status.DETACH: "detached"}
# The height of the mark of a kick, at the top of a panel, as a share of the panel's height.
KICK_HEIGHT = 0.045


def shade_status(axes: Axes, run: Trajectory, contact: int = 0) -> list[Patch]:
    """Shade where a contact (by its number) sticks or is detached. Returns legend entries for the statuses that occur."""
    handles = []
    statuses = np.asarray(run.status)
    statuses = statuses if statuses.ndim == 1 else statuses[:, contact]
    t = np.append(run.t, run.t[-1])
    for status, colour in STATUS_COLOURS.items():
        is_on = statuses == status
        if not is_on.any():
            continue
        hatch = "///" if status == Status.STICK else None
        # From the first row with the status to the first row with another, so that a single row is visible, too.
        edges = np.diff(np.concatenate([[False], is_on, [False]]).astype(int))
        begun, ended = t[np.flatnonzero(edges > 0)], t[np.flatnonzero(edges < 0)]
        axes.broken_barh(
            np.stack([begun, ended - begun], axis=1),
            (0, 1),
            transform=axes.get_xaxis_transform(),
            facecolor=colour,
            edgecolor="none",
            alpha=0.35,
            hatch=hatch,
            lw=0,
        )
        handles.append(Patch(facecolor=colour, alpha=0.5, hatch=hatch, label=STATUS_NAMES[status]))
    return handles


def mark_kick(axes: Axes, run: Trajectory) -> list[Patch]:
    """Mark the time of the kick at the top of a panel. Returns its legend entry; none if there is no kick."""
    load = run.scene.load
    if not isinstance(load, Pulse) or float(load.p) == 1 or float(load.start) >= run.t[-1]:
        return []
    axes.broken_barh(
        [(float(load.start), float(load.duration))],
        (1 - KICK_HEIGHT, KICK_HEIGHT),
        transform=axes.get_xaxis_transform(),
        facecolor=VERMILION,
        # With an edge, so that a short kick is visible in a long run.
        edgecolor=VERMILION,
        lw=1.2,
    )
    return [Patch(facecolor=VERMILION, label=f"kick, p = {float(load.p):g}")]
