"""The picture of a calibration: data and fit, residuals, and parameters. It computes nothing."""

import numpy as np
from matplotlib.figure import Figure

from ..calibration.result import Calibration
from ..foundation import arguments
from ..io.datasets import unit_of
from .style import BLACK, SKY, VERMILION, new_figure

MEASURED, FITTED, LEFT = SKY, BLACK, VERMILION
# The number of blocks shown in the detailed view of a fit.
DETAIL = 160


def calibration(fit: Calibration, *, figure: Figure | None = None) -> Figure:
    """Every channel of every recording: the beginning in detail, the whole with the residuals of the fit; the parameters above.

    A limit cycle is drawn over one period, into which the recording was folded.
    """
    arguments.instance("fit", fit, Calibration, "a calibration, such as `fivjax.calibrate(scene, data, free)`")
    rows = [(k, c) for k, recording in enumerate(fit.recordings) for c in range(len(recording.channels))]
    figure = new_figure(figure, 9.0, 1.4 + 0.19 * len(fit.names) + 2.1 * len(rows))
    axes = np.atleast_2d(figure.subplots(len(rows), 2, width_ratios=(3, 2)))
    units = {"acceleration": "m/s²", "velocity": "m/s", "displacement": "m"}
    for (k, c), (detail, whole) in zip(rows, axes, strict=True):
        t, measured, fitted = fit.t[k], fit.measured[k][:, c], fit.fitted[k][:, c]
        whole.plot(t, measured, color=MEASURED, lw=0.6)
        whole.plot(t, measured - fitted, color=LEFT, lw=0.6, ls="-", label="what is left")
        shown = slice(0, DETAIL)
        detail.plot(t[shown], measured[shown], color=MEASURED, lw=2.4, label="measured")
        detail.plot(t[shown], fitted[shown], color=FITTED, lw=0.9, ls="--", label="fitted")
        channel = fit.recordings[k].channels[c]
        name = f"{channel}" if len(fit.recordings) == 1 else f"recording {k}: {channel}"
        detail.set_ylabel(f"{name} ({units[channel.quantity]})")
        for part in (detail, whole):
            part.margins(x=0)
    axes[0, 0].legend(frameon=False, ncols=2, loc="lower right", bbox_to_anchor=(1, 1), fontsize="small")
    axes[0, 1].legend(frameon=False, loc="lower right", bbox_to_anchor=(1, 1), fontsize="small")
    for part in axes[-1]:
        part.set_xlabel("time (s)")
    lines = []
    for name in fit.names:
        unit = unit_of(name)
        unit = "" if unit in ("", "1") or not fit.identifiable[name] else f" {unit}"
        lines.append(f"{name} = {fit.value_text(name)}{unit}")
    figure.suptitle("\n".join([str(fit.outcome).split(":")[0], *lines]), ha="left", x=0.02, fontsize="small")
    return figure
