"""Spectra of a trajectory from its saved rows: spectrogram, harmonics, phase shift; by NumPy and SciPy."""

import numpy as np
import xarray as xr

import fivjax as fj


def spectrogram(run: fj.Trajectory, *, window: float = 0.2) -> xr.Dataset:
    """The spectrum of the tangential acceleration over time, as in Figs. 4(c) and 5(c).

    **Arguments:** `run`, with evenly spaced rows; `window`, the length in s of the Hann windows, which overlap by nine tenths;
    its inverse is the frequency resolution.

    **Returns:** a dataset over `frequency` (Hz) and `t` (the middle of each window, s) with `level`, the power relative to the
    strongest of all, in dB.

    **Raises:** `ValueError` for a window that does not fit into the run, or rows that are not evenly spaced.
    """
    rate = _sampling_rate(run)
    samples = round(window * rate)
    if not 8 <= samples <= len(run.t):
        raise ValueError(
            f"Argument `window` must hold at least 8 rows and fit into the run, but {window:g} s holds {samples} of "
            f"{len(run.t)} rows."
        )
    # Imported here, because it takes half a second.
    from scipy.signal import spectrogram as short_time_spectrum

    signal = np.asarray(run.acceleration)[:, run.scene.structure.tangential]
    frequency, t, power = short_time_spectrum(
        signal, rate, window="hann", nperseg=samples, noverlap=round(0.9 * samples), detrend="constant"
    )
    strongest = np.max(power)
    # The floor is far below the range that is drawn, and keeps levels finite.
    level = 10 * np.log10(np.maximum(power / (strongest if strongest > 0 else 1.0), 1e-20))
    return xr.Dataset(
        {"level": (("frequency", "t"), level, {"long_name": "power of acceleration", "units": "dB"})},
        {
            "frequency": ("frequency", frequency, {"long_name": "frequency", "units": "Hz"}),
            "t": ("t", float(run.t[0]) + t, {"long_name": "time", "units": "s"}),
        },
    )


def component(t: np.ndarray, signal: np.ndarray, frequency: float) -> complex:
    """The complex amplitude of one frequency (Hz) in an evenly sampled signal, with a Hann window."""
    # A Hann window reduces the amplitude of a sinusoid to half.
    hann_gain = 0.5
    weights = np.hanning(len(t)) / (hann_gain * len(t))
    return complex(2 * np.sum(weights * (signal - np.mean(signal)) * np.exp(-2j * np.pi * frequency * t)))


def harmonics(run: fj.Trajectory, window: tuple[float, float], frequency: float, count: int = 4) -> np.ndarray:
    """Levels of the tangential acceleration at 2, 3, … `count` times a frequency (Hz), relative to that frequency's, in dB."""
    inside, signal = _within(run, window, run.scene.structure.tangential)
    found = [abs(component(inside, signal, k * frequency)) for k in range(1, count + 1)]
    return 20 * np.log10(np.array(found[1:]) / found[0])


def phase_shift(run: fj.Trajectory, window: tuple[float, float], frequency: float, coordinate: int) -> float:
    """The phase lag of a coordinate's acceleration behind the tangential one at a frequency (Hz), in degrees, -180 to 180."""
    t, tangential = _within(run, window, run.scene.structure.tangential)
    _, other = _within(run, window, coordinate)
    return float(np.degrees(np.angle(component(t, tangential, frequency) / component(t, other, frequency))))


def _within(run: fj.Trajectory, window: tuple[float, float], coordinate: int) -> tuple[np.ndarray, np.ndarray]:
    inside = (np.asarray(run.t) >= window[0]) & (np.asarray(run.t) <= window[1])
    return np.asarray(run.t)[inside], np.asarray(run.acceleration)[inside, coordinate]


def _sampling_rate(run: fj.Trajectory) -> float:
    steps = np.diff(run.t)
    # The last row is the end of the run, which need not be a multiple of the step.
    if np.ptp(steps[:-1]) > 1e-6 * steps[0]:
        raise ValueError("Argument `run` must have rows at equal distances; `simulate` makes such runs.")
    return 1.0 / float(steps[0])
