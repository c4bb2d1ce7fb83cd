"""Quantities of a transient and its cycles: frequency, growth rate, linearity of growth, peaks, windows."""

import numpy as np
import xarray as xr

import fivjax as fj

Window = tuple[float, float]


def cycles_within(cycles: xr.Dataset, window: Window) -> np.ndarray:
    """Which cycles lie wholly in a window, to rounding."""
    rounding = 1e-9
    starts, ends = cycles["cycle_start"].values, cycles["cycle_end"].values
    return np.flatnonzero((starts >= window[0] - rounding) & (ends <= window[1] + rounding))


def frequency(cycles: xr.Dataset, window: Window) -> float:
    """Cycles per second in a window, from their own starts and ends."""
    inside = cycles_within(cycles, window)
    start, end = cycles["cycle_start"].values[inside], cycles["cycle_end"].values[inside]
    return len(start) / float(end[-1] - start[0])


def growth_rate(run: fj.Trajectory, cycles: xr.Dataset, window: Window) -> float:
    """Rate at which turning points move away from equilibrium in a window, in 1/s (a fitted exponential)."""
    inside = cycles_within(cycles, window)
    rest = fj.sliding_equilibrium(run.scene)[run.scene.structure.tangential]
    amplitude = rest - cycles["turning_point"].values[inside]
    return float(np.polyfit(cycles["cycle_start"].values[inside], np.log(amplitude), 1)[0])


def growing_mode(scene: fj.Scene) -> tuple[float, float]:
    """Frequency (Hz) of the mode that grows fastest in linear theory, and the phase between x2 and y1 in it (degrees)."""
    values, vectors = np.linalg.eig(fj.cea.linearisation(scene))
    k = int(np.argmax(values.real + 1e-9 * values.imag))
    return float(values[k].imag / (2 * np.pi)), float(np.degrees(np.angle(vectors[0, k] / vectors[1, k])))


def straightness(cycles: xr.Dataset, window: Window) -> float:
    """R² of a straight line through the amplitudes of the cycles in a window."""
    inside = cycles_within(cycles, window)
    t = cycles["cycle_start"].values[inside]
    amplitude = -cycles["turning_point"].values[inside]
    off = amplitude - np.polyval(np.polyfit(t, amplitude, 1), t)
    return float(1 - np.var(off) / np.var(amplitude))


def two_cycles(cycles: xr.Dataset, t: float, count: int = 2) -> Window:
    """The window of `count` cycles from the first one that begins at or after an instant (s)."""
    k = int(np.searchsorted(cycles["cycle_start"].values, t))
    k = min(k, cycles.sizes["cycle"] - count)
    return float(cycles["cycle_start"][k]), float(cycles["cycle_end"][k + count - 1])


def peak(run: fj.Trajectory, since: float, quantity: str = "acceleration") -> float:
    """Largest tangential value of a quantity from an instant (s) on."""
    late = np.asarray(run.t) >= since
    return float(np.abs(getattr(run, quantity)[late, run.scene.structure.tangential]).max())
