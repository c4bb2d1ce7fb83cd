"""Pictures of results. Every function takes results, returns a matplotlib `Figure`, and computes nothing.

Figures are made without `pyplot`, so nothing global is touched; pass `figure` to draw into one of your own. Colours are
Okabe and Ito's and matplotlib's perceptually uniform maps, and what matters is told by shade or line style as well.
"""

import json
from collections.abc import Mapping

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from ..contact import Status
from ..io.datasets import QUANTITIES
from ..simulation.trajectory import Trajectory
from ..verdicts.verdict import Verdict

BLACK, ORANGE, SKY, GREEN, BLUE, VERMILION, PURPLE = (
    "#000000",
    "#E69F00",
    "#56B4E9",
    "#009E73",
    "#0072B2",
    "#D55E00",
    "#CC79A7",
)
STATUS_COLOURS = {Status.STICK: ORANGE, Status.DETACH: SKY}
STATUS_NAMES = {Status.STICK: "sticking", Status.SLIDE: "sliding", Status.DETACH: "detached"}
SLIDING_SHADE = "#f2f2f2"


def bistability(
    dataset: xr.Dataset, *, critical: xr.Dataset | None = None, value: str = "amplitude", figure: Figure | None = None
) -> Figure:
    """A bi-stability map: where sliding returns, and how large the limit cycle is elsewhere.

    **Arguments:** `dataset` from `bistability_map` with two axes (the first is drawn to the right); `critical`, from
    `critical_perturbation`, drawn over it instead of the map's own, coarser boundary; `value`, what colours the limit
    cycles: "amplitude", "decided_at", "contact_events" or "last_event".

    **Raises:** `ValueError` for a map that does not have two axes.
    """
    names = dataset["verdict"].dims
    if len(names) != 2:
        raise ValueError(
            f"A map picture needs two axes, but this one has {len(names)}: {', '.join(map(str, names))}. "
            f"Select the others first, for instance `m.sel(belt_speed=3.0)`."
        )
    figure = figure or Figure(figsize=(7.2, 4.8), layout="constrained")
    axes = figure.add_subplot()
    x, y = dataset[names[0]].values, dataset[names[1]].values
    verdict = dataset["verdict"].values.T
    sliding = np.ma.masked_where(verdict != Verdict.SLIDING, np.ones_like(verdict, float))
    axes.pcolormesh(x, y, sliding, cmap=ListedColormap([SLIDING_SHADE]), shading="nearest", rasterized=True)
    cycle = np.ma.masked_where(verdict != Verdict.LIMIT_CYCLE, dataset[value].values.T)
    mesh = axes.pcolormesh(x, y, cycle, cmap="viridis", shading="nearest", rasterized=True)
    if cycle.count():
        long_name, unit = QUANTITIES.get(value, (value, "1"))
        figure.colorbar(mesh, ax=axes, label=_with_unit(long_name, unit))
    open_ = verdict < 0
    handles = [Patch(facecolor=SLIDING_SHADE, edgecolor="0.6", label="returns to sliding")]
    if open_.any():
        marked = np.ma.masked_where(~open_, np.ones_like(verdict, float))
        axes.pcolormesh(x, y, marked, cmap=ListedColormap([VERMILION]), shading="nearest", rasterized=True)
        handles.append(Patch(facecolor=VERMILION, label=f"no verdict ({int(open_.sum())} of {open_.size})"))
    boundary = dataset.get("p_crit") if critical is None else critical["p_crit"]
    if boundary is not None and boundary.dims == (names[0],):
        axes.plot(boundary[names[0]], boundary, color=BLACK, lw=1.6)
        handles.append(Line2D([], [], color=BLACK, lw=1.6, label=r"critical perturbation $p_\mathrm{crit}$"))
    for axis, name in ((axes.axvline, names[0]), (axes.axhline, names[1])):
        if name == "mu" and "mu_crit" in dataset.attrs:
            axis(dataset.attrs["mu_crit"], color=VERMILION, ls="--", lw=1.4)
            label = rf"$\mu_\mathrm{{crit}}$ = {dataset.attrs['mu_crit']:.4f} (linear theory)"
            handles.append(Line2D([], [], color=VERMILION, ls="--", label=label))
    _fit(axes.set_xlim, x, dataset.attrs.get("mu_crit") if names[0] == "mu" else None)
    _fit(axes.set_ylim, y, dataset.attrs.get("mu_crit") if names[1] == "mu" else None)
    axes.set(xlabel=_axis_label(dataset, names[0]), ylabel=_axis_label(dataset, names[1]))
    axes.legend(handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=2, frameon=False)
    axes.set_title("Bi-stability: colour where a kick leads to a limit cycle")
    return figure


def response(
    run: Trajectory, quantity: str = "acceleration", coordinate: int | None = None, *, figure: Figure | None = None
) -> Figure:
    """One coordinate over time (`quantity`: "displacement", "velocity", "acceleration"), the contact's status shaded."""
    figure = figure or Figure(figsize=(8.0, 3.6), layout="constrained")
    axes = figure.add_subplot()
    coordinate = run.scene.structure.tangential if coordinate is None else coordinate
    axes.plot(run.t, _of(run, quantity)[:, coordinate], color=BLACK, lw=0.8)
    handles = shade_status(axes, run)
    axes.set(xlabel="time (s)", ylabel=_with_unit(f"{_which(run, coordinate)} {quantity}", QUANTITIES[quantity][1]))
    axes.set_xlim(run.t[0], run.t[-1])
    if handles:
        axes.legend(handles=handles, loc="lower right", bbox_to_anchor=(1, 1), ncols=2, frameon=False)
    return figure


def shade_status(axes: Axes, run: Trajectory) -> list[Patch]:
    """Shade where the contact sticks or is detached; returns legend entries for what occurs."""
    handles = []
    t = np.append(run.t, run.t[-1])
    for status, colour in STATUS_COLOURS.items():
        is_on = np.asarray(run.status) == status
        if not is_on.any():
            continue
        hatch = "///" if status == Status.STICK else None
        # From the first row that has it to the row that has another, so that one row alone is seen too.
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


def phase_plane(
    runs: Trajectory | Mapping[str, Trajectory], last: float = 0.5, *, figure: Figure | None = None
) -> Figure:
    """Tangential velocity over displacement for the `last` seconds of one run or of several by label (Fig. 17)."""
    runs = runs if isinstance(runs, Mapping) else {"": runs}
    figure = figure or Figure(figsize=(5.6, 4.6), layout="constrained")
    axes = figure.add_subplot()
    styles = [(GREEN, "-"), (PURPLE, "--"), (BLUE, "-."), (ORANGE, ":"), (VERMILION, "-"), (BLACK, "--")]
    for (name, run), (colour, line) in zip(runs.items(), styles * (1 + len(runs) // len(styles)), strict=False):
        tangential = run.scene.structure.tangential
        end = np.asarray(run.t) >= run.t[-1] - last
        x, v = np.asarray(run.displacement)[end, tangential], np.asarray(run.velocity)[end, tangential]
        axes.plot(1e3 * x, v, color=colour, ls=line, lw=0.9, label=name)
    axes.set(xlabel="tangential displacement (mm)", ylabel="tangential velocity (m/s)")
    if any(runs):
        # Beside the orbits: they may be anywhere in the plane.
        axes.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=3, frameon=False)
    return figure


def perturbation(run: Trajectory, *, figure: Figure | None = None) -> Figure:
    """The load's pulse and the tangential acceleration that answers it (Fig. 8)."""
    figure = figure or Figure(figsize=(8.0, 4.8), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(1, 2))
    upper.step(run.t, run.load, where="post", color=VERMILION, lw=1.6)
    upper.set(ylabel="load (N)", ylim=(0, 1.15 * np.max(run.load)))
    tangential = run.scene.structure.tangential
    lower.plot(run.t, np.asarray(run.acceleration)[:, tangential], color=BLUE, lw=0.7)
    lower.set(xlabel="time (s)", ylabel="tangential acceleration (m/s²)", xlim=(run.t[0], run.t[-1]))
    return figure


def comparison(
    runs: Mapping[str, Trajectory], quantity: str = "acceleration", *, figure: Figure | None = None
) -> Figure:
    """The tangential response of several runs by label, each in a row of its own, on one scale (Fig. 9)."""
    figure = figure or Figure(figsize=(8.0, 1.2 + 1.9 * len(runs)), layout="constrained")
    rows = list(figure.subplots(len(runs), 1, sharex=True, sharey=True, squeeze=False)[:, 0])
    for axes, (name, run), colour in zip(rows, runs.items(), [BLUE, ORANGE, GREEN, PURPLE] * len(runs), strict=False):
        tangential = run.scene.structure.tangential
        axes.plot(run.t, _of(run, quantity)[:, tangential], color=colour, lw=0.7)
        handles = [Line2D([], [], color=colour, label=name), *shade_status(axes, run)]
        axes.legend(handles=handles, loc="lower right", bbox_to_anchor=(1, 1), ncols=3, frameon=False)
        axes.set_ylabel(_with_unit(f"tangential\n{quantity}", QUANTITIES[quantity][1]))
        axes.set_xlim(run.t[0], run.t[-1])
    rows[-1].set_xlabel("time (s)")
    return figure


def critical(dataset: xr.Dataset, *, figure: Figure | None = None) -> Figure:
    """The critical perturbation over one parameter (Fig. 10, Table 2); hollow where more crossings were seen above it.

    **Raises:** `ValueError` for a dataset over several parameters.
    """
    names = dataset["p_crit"].dims
    if len(names) != 1:
        raise ValueError(
            f"This picture needs p_crit over one parameter, but it is over {len(names)}; select the others."
        )
    figure = figure or Figure(figsize=(6.4, 4.2), layout="constrained")
    axes = figure.add_subplot()
    x, p = dataset[names[0]].values, dataset["p_crit"].values
    only = dataset["only_crossing"].values.astype(bool)
    limit = dataset.attrs.get("mu_crit", np.inf) if names[0] == "mu" else np.inf
    # At the limit of linear theory the curve ends; beyond it sliding is left without a kick.
    for part in (x < limit, x >= limit):
        axes.plot(x[part], p[part], color=BLUE, lw=1.0)
    axes.plot(x[only], p[only], "o", color=BLUE, ms=4, label="only crossing seen")
    if (~only & np.isfinite(p)).any():
        axes.plot(x[~only], p[~only], "o", color=BLUE, mfc="white", ms=5, label="islands seen above")
        axes.legend(frameon=False)
    if names[0] == "belt_speed" and len(x) > 1 and x[0] > 0 and x[-1] / x[0] > 30:
        axes.set_xscale("log")
    low, high = json.loads(dataset.attrs.get("range", "[null, null]"))
    if np.isfinite(limit):
        axes.axvline(limit, color=VERMILION, ls="--", lw=1.2)
        axes.annotate(
            rf"$\mu_\mathrm{{crit}}$ = {limit:.4f}" "\n(linear theory)",
            (limit, 0.97),
            (-6, 0),
            xycoords=("data", "axes fraction"),
            textcoords="offset points",
            ha="right",
            va="top",
        )
    axes.set(
        xlabel=_axis_label(dataset, names[0]),
        ylabel=r"critical perturbation $p_\mathrm{crit}$",
        title=f"Smallest kick to the limit cycle (sought in {low:g}–{high:g})" if low is not None else "",
    )
    return figure


def tradeoff(dataset: xr.Dataset, *, figure: Figure | None = None) -> Figure:
    """A work–precision picture of `fj.tradeoff`: what a lane-cycle costs, against the error of the state."""
    figure = figure or Figure(figsize=(7.2, 4.8), layout="constrained")
    axes = figure.add_subplot(xscale="log", yscale="log")
    fills = {"float64": BLUE, "float32": "white"}
    for kind in dataset["precision"].values:
        rows = dataset.sel(precision=kind)
        shown = np.isfinite(rows["state_error"].values) & (rows["state_error"].values > 0)
        x, y = 1e6 * rows["cost"].values[shown], rows["state_error"].values[shown]
        axes.scatter(x, y, s=36, facecolor=fills[str(kind)], edgecolor=BLUE, label=str(kind), zorder=3)
        if kind == "float64":
            for name, at, error in zip(rows["stepper"].values[shown], x, y, strict=True):
                axes.annotate(str(name), (at, error), (6, 3), textcoords="offset points", fontsize="small")
    axes.set_xlabel("cost of a lane-cycle (µs)")
    axes.set_ylabel("relative error of the state")
    axes.margins(x=0.25)
    axes.grid(alpha=0.3, which="major")
    axes.legend(title="precision")
    return figure


def _of(run: Trajectory, quantity: str) -> np.ndarray:
    if quantity not in ("displacement", "velocity", "acceleration"):
        raise ValueError(
            f'Argument `quantity` must be one of "displacement", "velocity", "acceleration", but is {quantity!r}.'
        )
    return np.asarray(getattr(run, quantity))


def _which(run: Trajectory, coordinate: int) -> str:
    structure = run.scene.structure
    return {structure.tangential: "tangential", structure.normal: "normal"}.get(coordinate, f"coordinate {coordinate}")


def _axis_label(dataset: xr.Dataset, name) -> str:
    long_name, unit = QUANTITIES.get(str(name), (str(name), "1"))
    symbol = {"mu": r" $\mu$", "p": " $p$"}.get(str(name), "")
    return _with_unit(long_name + symbol, unit)


def _with_unit(text: str, unit: str) -> str:
    return text if unit == "1" else f"{text} ({unit.replace('2', '²')})"


def _fit(set_limits, values: np.ndarray, also: float | None) -> None:
    half = 0.5 * (values[1] - values[0]) if len(values) > 1 else 0.5
    low, high = values[0] - half, values[-1] + half
    if also is not None and high < also < high + 0.1 * (high - low):
        high = also + 0.02 * (high - low)
    set_limits(low, high)
