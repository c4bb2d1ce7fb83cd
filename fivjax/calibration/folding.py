r"""A periodic recording folded into one period: its frequency, its waveform, its noise, and whether it is periodic at all.

Samples of a vibration of frequency f that are taken at instants t show its waveform at the phases f t, up to whole turns. Over
many periods these lie close together, however few samples a period has: of a vibration of 68 Hz, a thousand samples per second
show a thousand phases in a second. So a rate that is low for the higher lines loses nothing. It must be
above twice the fundamental, which is found in a spectrum: there lines that are too high for the rate look like others.

`folded` finds the frequency, and means of the samples over groups of neighbouring phases, for a few parts of the recording:
from part to part a waveform of another frequency moves. What differs between neighbours is noise. What is then left beside the
fundamental are sidebands, by which a vibration beats or has not settled.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from .noise import estimated_noise, from_third_differences, robust_deviation, rounding, taper

# The most groups: of phases, many, so that few samples lie beside a jump; and of times. Four of these tell the frequency with
# nearly the error of all samples: the mean square of their times is 15/16 of that of all.
PHASES, TIMES = 2048, 4
MOST_HARMONICS = 8


class Folded(NamedTuple):
    """One period of a recording. Phases are in turns, and times in s, from the middle of the recording on."""

    frequency: float  # Hz
    phases: Float[np.ndarray, " g"]  # of the groups, from 0 to 1
    times: Float[np.ndarray, " g"]
    counts: Float[np.ndarray, " g"]  # of samples in each
    means: Float[np.ndarray, "g k"]
    apart: Float[np.ndarray, " g"]  # to the farther of the two neighbouring phases, in turns
    noise: Float[np.ndarray, " k"]  # of single samples
    lines: Complex[np.ndarray, "h k"]  # harmonics of the waveform
    sidebands: float  # of the fundamental, relative to it: how much the vibration beats


def folded(
    samples: Float[np.ndarray, "T k"],
    rate: float,
    lowest: float,
    highest: float,
    noise: Float[np.ndarray, " k"] | None = None,
) -> Folded:
    """A recording folded into one period of the frequency that is strongest between `lowest` and `highest` (Hz).

    Unless the `noise` of samples is given by channel, it is estimated from neighbours in phase.
    """
    # The residuals of harmonics alone find the frequency roughly, those of neighbours exactly.
    by_harmonics, by_neighbours = 3, 3
    t = (np.arange(len(samples)) - 0.5 * (len(samples) - 1)) / rate
    deviation = samples.std(axis=0)
    size = np.where(deviation > 0, deviation, 1.0)
    # Where there is little but noise, a channel says little of the frequency and of beats.
    vibrating = np.clip(1 - (estimated_noise(samples) / size) ** 2, 1e-3, 1.0)
    scaled = (samples - samples.mean(axis=0)) / size * vibrating**2
    frequency = _strongest(scaled, 1 / rate, lowest, highest)
    count = max(1, min(MOST_HARMONICS, len(samples) // 8))
    for k in range(by_harmonics + by_neighbours):
        frequency += _correction(scaled, t, frequency, count, by_neighbours=k >= by_harmonics)
        frequency = float(np.clip(frequency, lowest, highest))
    phases = np.mod(frequency * t, 1.0)
    order = np.argsort(phases, kind="stable")
    sigma = np.maximum(_between_neighbours(samples[order]), rounding(samples)) if noise is None else noise
    groups = [part for cell in np.array_split(order, min(len(order), PHASES)) for part in _by_time(cell, t)]
    if len(order) <= PHASES * TIMES:
        groups = [order[k : k + 1] for k in range(len(order))]
    counts = np.array([len(group) for group in groups], float)
    middles, times = (np.array([part[group].mean() for group in groups]) for part in (phases, t))
    means = np.array([samples[group].mean(axis=0) for group in groups])
    waves = _waves(middles, max(1, min(count, len(middles) // 4)))
    weight = np.sqrt(counts)[:, None]
    shares = np.linalg.lstsq(weight * waves, weight * means, rcond=None)[0]
    harmonics = waves.shape[1] // 2
    return Folded(
        frequency=frequency,
        phases=middles,
        times=times,
        counts=counts,
        means=means,
        apart=_apart(middles, len(groups) // PHASES if len(order) > PHASES * TIMES else 1),
        noise=np.asarray(sigma),
        lines=shares[1 : harmonics + 1] - 1j * shares[harmonics + 1 :],
        sidebands=_sidebands(scaled, t, frequency, count, rate),
    )


def _by_time(cell, t) -> list[np.ndarray]:
    """Samples of neighbouring phases, by time."""
    return [part for part in np.array_split(cell[np.argsort(t[cell], kind="stable")], TIMES) if len(part)]


def _apart(phases, together: int) -> Float[np.ndarray, " g"]:
    """The distance to the farther neighbour in phase, for groups of which so many have nearly the same."""
    cells = phases.reshape(-1, together).mean(axis=1)
    gaps = np.diff(np.append(cells, cells[0] + 1.0))
    return np.repeat(np.maximum(gaps, np.roll(gaps, 1)), together)


def _correction(scaled, t, frequency: float, count: int, by_neighbours: bool) -> float:
    """A step of the frequency (Hz).

    A sample at time t changes by t times the waveform's slope (by phase) for each Hz. So what a sample differs by from its
    neighbours in phase, whose times are others, tells the frequency, whatever lines the waveform has.
    """
    phases = np.mod(frequency * t, 1.0)
    waves = _waves(phases, count)
    shares = np.linalg.lstsq(waves, scaled, rcond=None)[0]
    orders = 2 * np.pi * np.arange(1, count + 1)
    slopes = (orders * waves[:, 1 : count + 1]) @ shares[count + 1 :]
    slopes -= (orders * waves[:, count + 1 :]) @ shares[1 : count + 1]
    along = slopes * t[:, None]
    left = _from_neighbours(scaled, phases) if by_neighbours else scaled - waves @ shares
    return float(np.sum(along * left) / max(np.sum(along**2), 1e-300))


def _from_neighbours(samples, phases):
    """The samples less the median of their neighbours in phase, which keeps to one side of a jump."""
    width = _neighbours(samples)
    order, half = np.argsort(phases, kind="stable"), width // 2
    around = np.concatenate([order[-half:], order, order[:half]])
    windows = np.lib.stride_tricks.sliding_window_view(samples[around], width, axis=0)
    left = np.empty_like(samples)
    left[order] = samples[order] - np.median(windows, axis=-1)
    return left


def _neighbours(samples) -> int:
    # Neighbours in phase whose median is the waveform; more of them where there are many samples.
    neighbours = 9
    return min(neighbours + 2 * (len(samples) // 2000), 2 * ((len(samples) - 1) // 4) + 1)


def _between_neighbours(ordered):
    """The noise of single samples, from third differences in the order of phases."""
    return from_third_differences(np.concatenate([ordered, ordered[:3]]))


def _sidebands(scaled, t, frequency: float, count: int, rate: float) -> float:
    """How much a vibration beats: what neighbours in phase differ by, below one and a half times its frequency and above its
    noise, relative to its fundamental. Few samples do not tell."""
    # The widest that neighbours may lie, in turns, whose differences tell a beat: over more, a waveform bends.
    widest = 1 / 16
    # Scatters of the noise's power that sidebands exceed.
    above_scatter = 5.0
    if _neighbours(scaled) > widest * len(scaled):
        return 0.0
    left = _from_neighbours(scaled, np.mod(frequency * t, 1.0))
    spread = np.maximum(robust_deviation(left), 1e-12)
    weight = taper(len(left))
    spectrum = np.abs(np.fft.rfft(left / spread * weight[:, None], axis=0)) ** 2 / np.sum(weight**2)
    low = np.fft.rfftfreq(len(left), 1 / rate) < 1.5 * frequency
    bins = np.sum(low) * left.shape[1]
    # The taper makes neighbouring lines alike: half of them count.
    noise = bins * (1 + above_scatter * np.sqrt(2.0 / bins))
    between = max(np.sum(spectrum[low]) - noise, 0.0) * 2 / len(left)
    waves = _waves(np.mod(frequency * t, 1.0), count)
    shares = np.linalg.lstsq(waves, scaled / spread, rcond=None)[0]
    fundamental = np.sum(0.5 * (shares[1] ** 2 + shares[count + 1] ** 2))
    return float(np.sqrt(between / fundamental)) if fundamental > 0 else 0.0


def _waves(phases, count: int) -> Float[np.ndarray, "B wave"]:
    turns = 2 * np.pi * phases[:, None] * np.arange(1, count + 1)
    return np.concatenate([np.ones((len(phases), 1)), np.cos(turns), np.sin(turns)], axis=1)


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
