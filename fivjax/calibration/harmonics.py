r"""Harmonics of a measured limit cycle: its frequency and Fourier coefficients, and their errors by noise.

A limit cycle is a Fourier series. `fitted_harmonics` finds its frequency and its coefficients, relative to the phase of the
first channel's fundamental, with their covariance; `beating` says whether the vibration is periodic at all. None of these
depends on a phase, so a fit to them has no false minima a period away.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

REFINEMENTS = 5


class Harmonics(NamedTuple):
    """A periodic signal, by numbers that do not depend on its phase; see `referred`."""

    frequency: float  # Hz
    values: Float[np.ndarray, " m"]
    covariance: Float[np.ndarray, "m m"]


def fitted_harmonics(
    means: Float[np.ndarray, "B k"],
    dt: float,
    count: int,
    lowest: float,
    highest: float,
    sigma: Float[np.ndarray, " k"],
) -> Harmonics:
    r"""Frequency and `count` lines of evenly spaced signals, `dt` s apart, with white noise of `sigma` by channel.

    The frequency is sought between `lowest` and `highest` (Hz). Then frequency, means and lines of all channels are
    fitted together, by least squares with a tapered weight (Gauss–Newton). By impacts, accelerations have infinitely many
    lines; those above `count`, and their aliases between the lines, would leak into the fitted ones, which the taper
    prevents. The covariance is that by the noise of all samples, to first order.
    """
    sigma = np.where(sigma > 0, sigma, 1.0)
    # With time measured from the middle, errors of the frequency and of the phases are uncorrelated.
    t = dt * (np.arange(len(means)) - 0.5 * (len(means) - 1))
    weight = taper(len(means))
    frequency = _strongest(means / sigma, dt, lowest, highest)
    fit = _lines(t, means, sigma, weight, frequency, count)
    for _ in range(REFINEMENTS):
        frequency = float(np.clip(frequency + fit.step, lowest, highest))
        fit = _lines(t, means, sigma, weight, frequency, count)
    # Each number is a linear function of the samples: first the frequency, then the lines, which depend on it.
    variance = np.sum((fit.to_frequency * sigma) ** 2)
    errors = np.zeros((1 + 2 * count * means.shape[1],) * 2)
    errors[0, 0] = variance
    columns = [slice(1 + 2 * count * k, 1 + 2 * count * (k + 1)) for k in range(means.shape[1])]
    shared = [fit.to_lines @ (fit.to_frequency[:, k] * sigma[k] ** 2) for k in range(means.shape[1])]
    for k, own in enumerate(columns):
        errors[0, own] = errors[own, 0] = shared[k] - fit.follow[:, k] * variance
        for j, other in enumerate(columns):
            block = np.outer(fit.follow[:, k], fit.follow[:, j]) * variance
            block -= np.outer(shared[k], fit.follow[:, j]) + np.outer(fit.follow[:, k], shared[j])
            if j == k:
                block += sigma[k] ** 2 * (fit.to_lines @ fit.to_lines.T)
            errors[own, other] = block
    values, slopes = referred(frequency, fit.found)
    return Harmonics(frequency, values, slopes @ errors @ slopes.T)


class _Lines(NamedTuple):
    """Lines at one frequency, by weighted least squares; a correction of the frequency; and the derivatives of both by the
    samples.
    """

    found: Complex[np.ndarray, "count k"]
    step: float  # Gauss–Newton step of the frequency, Hz
    to_frequency: Float[np.ndarray, "B k"]
    to_lines: Float[np.ndarray, "m B"]  # cosines, then sines, of every channel
    follow: Float[np.ndarray, "m k"]  # minus the derivative of the lines by the frequency


def _lines(t, means, sigma, weight, frequency: float, count: int) -> _Lines:
    waves = _waves(t, frequency, count)
    # Over several periods the columns are nearly orthogonal, so the normal equations are well conditioned.
    onto = np.linalg.solve((waves.T * weight) @ waves, waves.T * weight)
    shares = onto @ means
    found = shares[1 : count + 1] - 1j * shares[count + 1 :]
    turning = 2j * np.pi * t[:, None] * np.arange(1, count + 1) * (waves[:, 1 : count + 1] + 1j * waves[:, count + 1 :])
    # The derivative of the signals by the frequency, without the part that a change of the lines can make up for.
    along = (turning @ found).real
    follow = onto @ along
    along = along - waves @ follow
    towards = weight[:, None] * along / sigma**2
    curvature = np.sum(towards * along)
    to_frequency = towards / curvature if curvature > 0 else np.zeros_like(towards)
    step = float(np.sum(to_frequency * (means - waves @ shares)))
    return _Lines(found, step, to_frequency, onto[1:], follow[1:])


def referred(
    frequency: float, found: Complex[np.ndarray, "count k"]
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m j"]]:
    """Frequency (Hz), then the amplitude of the first channel's fundamental, then the real and imaginary parts of all other
    lines, for a time origin at which this fundamental has phase zero.

    Also their derivatives by the frequency and by the cosines and sines of the lines, channel after channel.
    """
    count, channels = found.shape
    orders = np.arange(1, count + 1)[:, None]
    size = np.abs(found[0, 0])
    phase = found[0, 0] / size if size > 0 else 1.0
    turned = found * np.conj(phase) ** orders
    values = _in_order(frequency, size, turned)
    slopes = np.zeros((len(values), 1 + 2 * found.size))
    slopes[0, 0] = 1.0
    for k, sine, h in np.ndindex(channels, 2, count):
        change = np.zeros_like(found)
        # The complex amplitude of a line is its cosine minus i times its sine.
        change[h, k] = -1j if sine else 1.0
        relative = change[0, 0] / found[0, 0] if size > 0 else 0.0
        moved = (change - 1j * orders * found * np.imag(relative)) * np.conj(phase) ** orders
        slopes[:, 1 + (k * 2 + sine) * count + h] = _in_order(0.0, size * np.real(relative), moved)
    return values, slopes


def _in_order(frequency, size, turned):
    rest = turned.ravel()[1:]
    return np.concatenate([[frequency, size], rest.real, rest.imag])


def beating(signals: Float[np.ndarray, "T k"], dt: float, frequency: float, sigma: Float[np.ndarray, " k"]) -> float:
    """How much a vibration beats: the size of the sidebands of its fundamental, relative to it.

    They are what a constant and two harmonics leave below one and a half times the `frequency` (Hz), without the noise of
    `sigma` by channel. Sidebands show that amplitude or frequency vary. There should be many samples per period: impacts have
    infinitely many lines, and their aliases look like sidebands.
    """
    t = dt * (np.arange(len(signals)) - 0.5 * (len(signals) - 1))
    waves, weight = _waves(t, frequency, 2), taper(len(signals))
    scale = np.where(sigma > 0, sigma, 1.0)
    shares = np.linalg.solve((waves.T * weight) @ waves, (waves.T * weight) @ (signals / scale))
    left = signals / scale - waves @ shares
    spectrum = np.abs(np.fft.rfft(left * weight[:, None], axis=0)) ** 2
    low = np.fft.rfftfreq(len(signals), dt) < 1.5 * frequency
    # Half of the power of a real signal is at the negative frequencies.
    noise = np.sum(low) * np.sum(weight**2) * signals.shape[1]
    between = max(np.sum(spectrum[low]) - 2 * noise, 0.0) / (0.5 * len(signals) * np.sum(weight**2))
    fundamental = np.sum(0.5 * (shares[1] ** 2 + shares[3] ** 2))
    return float(np.sqrt(between / fundamental)) if fundamental > 0 else 0.0


def without_lines(
    means: Float[np.ndarray, "B k"], dt: float, frequency: float, count: int
) -> tuple[Float[np.ndarray, "B k"], Complex[np.ndarray, "count k"]]:
    """The residuals of a constant and `count` harmonics of this frequency (Hz), by least squares; and the harmonics, with
    phases at the first sample.
    """
    waves = _waves(dt * np.arange(len(means)), frequency, count)
    shares = np.linalg.lstsq(waves, means, rcond=None)[0]
    return means - waves @ shares, shares[1 : count + 1] - 1j * shares[count + 1 :]


def taper(count: int) -> Float[np.ndarray, " count"]:
    """A weight over evenly spaced instants whose spectrum falls off fast: below a thousandth from the fourth line on."""
    return np.hanning(count) ** 2


def _waves(t, frequency: float, count: int) -> Float[np.ndarray, "B wave"]:
    turns = 2 * np.pi * frequency * t[:, None] * np.arange(1, count + 1)
    return np.concatenate([np.ones((len(t), 1)), np.cos(turns), np.sin(turns)], axis=1)


def _strongest(signals, dt: float, lowest: float, highest: float) -> float:
    """The frequency (Hz), between two bounds, at which the spectrum is highest, by a parabola through its maximum."""
    padded = 4 * len(signals)
    spectrum = np.abs(np.fft.rfft(signals * np.hanning(len(signals))[:, None], padded, axis=0)) ** 2
    power, candidates = np.sum(spectrum, axis=1), np.fft.rfftfreq(padded, dt)
    top = int(np.argmax(np.where((candidates >= lowest) & (candidates <= highest), power, -1.0)))
    if not 0 < top < len(power) - 1:
        return float(candidates[top])
    before, here, after = power[top - 1 : top + 2]
    bend = before - 2 * here + after
    aside = 0.5 * (before - after) / bend if bend < 0 else 0.0
    return float(np.clip(candidates[top] + np.clip(aside, -0.5, 0.5) * candidates[1], lowest, highest))
