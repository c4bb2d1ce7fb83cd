"""The picture of a calibration: data and fit, residuals, and parameters. It computes nothing."""

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from ..calibration.result import Calibration
from .style import BLACK, SKY, VERMILION, check_dataset, new_figure

MEASURED, FITTED, LEFT = SKY, BLACK, VERMILION
# The number of blocks shown in the detailed view of a fit.
DETAIL = 160


def calibration(fit: Calibration | xr.Dataset, *, figure: Figure | None = None) -> Figure:
    """Every channel of every recording: the beginning in detail, the whole with the residuals of the fit; the parameters above.

    A limit cycle is drawn over one period, into which the recording was folded. `fit` may be its dataset, as it is saved.
    """
    found = fit.to_dataset() if isinstance(fit, Calibration) else fit
    check_dataset(found, ("offset", "value_text"), "fj.calibrate(scene, data, free)", name="fit")
    recordings = found.sizes["recording"]
    rows = [(k, c) for k in range(recordings) for c in range(found.sizes[f"channel_{k}"])]
    figure = new_figure(figure, 9.0, 1.4 + 0.19 * found.sizes["parameter"] + 2.1 * len(rows))
    axes = np.atleast_2d(figure.subplots(len(rows), 2, width_ratios=(3, 2)))
    for (k, c), (detail, whole) in zip(rows, axes, strict=True):
        t, measured, fitted = (found[f"{name}_{k}"].values for name in ("t", "measured", "fitted"))
        measured, fitted = measured[:, c], fitted[:, c]
        whole.plot(t, measured, color=MEASURED, lw=0.6)
        whole.plot(t, measured - fitted, color=LEFT, lw=0.6, ls="-", label="what is left")
        shown = slice(0, DETAIL)
        detail.plot(t[shown], measured[shown], color=MEASURED, lw=2.4, label="measured")
        detail.plot(t[shown], fitted[shown], color=FITTED, lw=0.9, ls="--", label="fitted")
        channel, unit = (str(found[f"{name}_{k}"].values[c]) for name in ("channel", "unit"))
        name = channel if recordings == 1 else f"recording {k}: {channel}"
        detail.set_ylabel(f"{name} ({unit.replace('s2', 's²')})")
        for part in (detail, whole):
            part.margins(x=0)
    axes[0, 0].legend(frameon=False, ncols=2, loc="lower right", bbox_to_anchor=(1, 1), fontsize="small")
    axes[0, 1].legend(frameon=False, loc="lower right", bbox_to_anchor=(1, 1), fontsize="small")
    for part in axes[-1]:
        part.set_xlabel("time (s)")
    lines = [found.attrs["outcome"].split(":")[0]]
    for one in (found.isel(parameter=k) for k in range(found.sizes["parameter"])):
        unit = "" if one["unit"] in ("", "1") or not one["identifiable"] else f" {one['unit'].item()}"
        lines.append(f"{one['parameter'].item()} = {one['value_text'].item()}{unit}")
    figure.suptitle("\n".join(lines), ha="left", x=0.02, fontsize="small")
    return figure
