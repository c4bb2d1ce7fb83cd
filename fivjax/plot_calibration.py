"""A picture of a calibration: data against fit, what is left, and the parameters. It draws and computes nothing."""

import numpy as np
from matplotlib.figure import Figure

from .calibrate import Calibration
from .results import QUANTITIES

MEASURED, FITTED, LEFT = "#56B4E9", "#000000", "#D55E00"
UNITS = {"acceleration": "m/s²", "velocity": "m/s"}
# A fit is looked at in its details and as a whole: so many blocks of the first, all of the second.
DETAIL = 160


def calibration(fit: Calibration, *, figure: Figure | None = None) -> Figure:
    """Every channel of every recording: the beginning in detail, the whole with what the fit leaves; the parameters above.

    A limit cycle is fitted by its harmonics, so its measured and fitted waveforms have no common phase: each is drawn from
    its own first upward crossing.
    """
    rows = [(k, c) for k, recording in enumerate(fit.recordings) for c in range(len(recording.channels))]
    figure = figure or Figure(figsize=(9.0, 1.4 + 0.19 * len(fit.names) + 2.1 * len(rows)), layout="constrained")
    axes = np.atleast_2d(figure.subplots(len(rows), 2, width_ratios=(3, 2)))
    for (k, c), (detail, whole) in zip(rows, axes, strict=True):
        recording = fit.recordings[k]
        t, measured, fitted = fit.t[k], fit.measured[k][:, c], fit.fitted[k][:, c]
        if recording.regime == "limit cycle":
            measured, fitted, t = _aligned(fit.measured[k], fit.fitted[k], c, t)
            _bands(whole, t, measured, fitted)
            whole.set_title("one above the other, each from its own upward crossing", fontsize="small")
        else:
            whole.plot(t, measured, color=MEASURED, lw=0.6)
            whole.plot(t, measured - fitted, color=LEFT, lw=0.6, ls="-", label="what is left")
        shown = slice(0, DETAIL)
        detail.plot(t[shown], measured[shown], color=MEASURED, lw=2.4, label="measured")
        detail.plot(t[shown], fitted[shown], color=FITTED, lw=0.9, ls="--", label="fitted")
        channel = recording.channels[c]
        name = f"{channel}" if len(fit.recordings) == 1 else f"recording {k}: {channel}"
        detail.set_ylabel(f"{name} ({UNITS[channel.quantity]})")
        for part in (detail, whole):
            part.margins(x=0)
    axes[0, 0].legend(frameon=False, ncols=2, loc="lower right", bbox_to_anchor=(1, 1), fontsize="small")
    if fit.recordings[rows[0][0]].regime != "limit cycle":
        axes[0, 1].legend(frameon=False, loc="lower right", bbox_to_anchor=(1, 1), fontsize="small")
    for part in axes[-1]:
        part.set_xlabel("time (s)")
    lines = []
    for name in fit.names:
        unit = QUANTITIES.get(name, ("", "1"))[1]
        unit = "" if unit == "1" else f" {unit}"
        told = fit.identifiable[name]
        value = f"{fit.values[name]:.6g} ± {fit.uncertainty[name]:.2g}{unit}" if told else "not identifiable"
        lines.append(f"{name} = {value}")
    figure.suptitle("\n".join([str(fit.outcome).split(":")[0], *lines]), ha="left", x=0.02, fontsize="small")
    return figure


def _aligned(measured, fitted, c: int, t):
    """Both from the first upward crossing of the first channel onwards."""
    count = min(len(measured), len(fitted))

    def begun(means):
        rising = np.flatnonzero((means[:-1, 0] < 0) & (means[1:, 0] >= 0))
        return means[(rising[0] + 1 if rising.size else 0) :, c]

    measured, fitted = begun(measured[:count]), begun(fitted[:count])
    count = min(len(measured), len(fitted))
    return measured[:count], fitted[:count], t[:count]


def _bands(axes, t, measured, fitted) -> None:
    axes.plot(t, measured, color=MEASURED, lw=0.6)
    axes.plot(t, fitted, color=FITTED, lw=0.4, ls="--")
