"""Recordings: measured signals with their time base, and what is known of the run they came from.

A recording is read from a file (`recording_files`) or made from arrays (`Recording`). It says how it was sampled: at points
in time, as an accelerometer's converter does, by averages about each sample's instant, or either after a low-pass.
A model is sampled in the same way before the two are compared, so nothing that a sample is not is fitted to it.
"""

import math
import re
from collections.abc import Mapping
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..foundation import arguments
from ..foundation.digits import apart
from .low_pass import FrequencyResponse, frequency_response

# Quantities of a channel, in the order of their derivatives by time.
QUANTITIES = ("displacement", "velocity", "acceleration")
# Time stamps are often rounded to few digits; steps that differ by more than this share of a step are uneven.
UNEVEN = 0.05
SHORTEST = 16


class Channel(NamedTuple):
    """One measured signal: "displacement", "velocity" or "acceleration" of one coordinate of the structure."""

    quantity: str
    coordinate: int

    @property
    def derivative(self) -> int:
        """Which derivative of the displacement by time it is: 0, 1 or 2."""
        return QUANTITIES.index(self.quantity)

    def __str__(self) -> str:
        return f"{self.quantity} {self.coordinate}"


class Recording(eqx.Module):
    """Signals of one run, evenly sampled, in SI units.

        fj.Recording(t, {"acceleration 0": a_x, "acceleration 1": a_y}, "kick", belt_speed=3.0, p=1.2)

    **Arguments:**

    - `t`: `(T,)` instants in s, evenly spaced, or one number: the sampling rate in Hz.
    - `signals`: `(T,)` arrays by channel, "displacement i" (m), "velocity i" (m/s) or "acceleration i" (m/s²) of coordinate i.
    - `regime`: what was recorded.
      "sliding": a small motion about steady sliding, growing or decaying, whatever set it off.
      "kick": the response to the scene's own load from steady sliding, or from `y0`; any contact events.
      "limit cycle": a vibration that keeps its amplitude.
    - `sampling`: what a sample is. "points": the value at its instant, as analogue-to-digital converters take it. "averages":
      the mean over the time from half a step before its instant to half a step after.
    - `filter`: the low-pass before the sampler: a pair of cut-off (Hz) and order of a Butterworth filter, or a function that
      gives the complex factor for each frequency (Hz, an array). Unless given, the sensor passes everything.
    - `y0`: for a kick, the state at the simulation's start, as for `simulate`. Unless given it is steady sliding; on a belt at
      rest, where nothing slides steadily, it is unknown and fitted, and the recording begins with the simulation.
    - `offset`: for a kick, the time of the simulation (s) at which the recording's first sample lies, as one number if known,
      else as the range to search: (0, 0.5) unless given, or 0 with `y0`. A fit may leave the range, and then says so. A
      recording that begins before the simulation has a negative offset.
    - `noise`: standard deviation of one sample, by channel or one number for all. Unless given, white noise is assumed and
      estimated from the differences between neighbouring samples or from the quiet part of the spectrum.
    - `sticking`, `detached`: for a limit cycle, the measured fraction of time in this status, as a pair: the value and its
      standard deviation.
    - `known`: parameters of the scene that were different in this run, by name: `belt_speed=1.0, force=50.0`.

    **Raises:** `ValueError` or `TypeError`, as a sentence, for signals that are not finite, not evenly sampled, of unequal
    length or shorter than 16 samples, and for names that mean nothing.

    **Example:**

        >>> data = fj.Recording(run.t, {"acceleration 0": run.acceleration[:, 0]}, "kick", p=1.2)
    """

    t: Float[np.ndarray, " T"]
    values: Float[np.ndarray, "T k"]
    channels: tuple[Channel, ...] = eqx.field(static=True)
    regime: str = eqx.field(static=True)
    sampling: str = eqx.field(static=True)
    filter: FrequencyResponse | None = eqx.field(static=True)
    y0: Float[np.ndarray, " state"] | None
    offset: tuple[float, float]
    noise: Float[np.ndarray, " k"] | None
    sticking: tuple[float, float] | None
    detached: tuple[float, float] | None
    known: dict[str, float]

    def __repr__(self) -> str:
        known = "".join(f", {name} = {value:g}" for name, value in self.known.items())
        span = f"{len(self.t)} samples from {self.t[0]:g} to {self.t[-1]:g} s"
        return f'Recording ("{self.regime}"): {", ".join(map(str, self.channels))}; {span}{known}'

    def __init__(
        self,
        t,
        signals: Mapping,
        regime: str = "kick",
        sampling: str = "points",
        *,
        filter=None,
        y0=None,
        offset=None,
        noise: Mapping | float | None = None,
        sticking: tuple[float, float] | None = None,
        detached: tuple[float, float] | None = None,
        **known,
    ):
        regimes = ("sliding", "kick", "limit cycle")
        arguments.one_of("regime", regime, regimes)
        samplings = ("points", "averages")
        arguments.one_of("sampling", sampling, samplings)
        if not isinstance(signals, Mapping):
            raise TypeError(
                f"Argument `signals` must map channels to arrays, such as {{'acceleration 0': a}}, but is "
                f"{arguments.describe(signals)}."
            )
        if not signals:
            raise ValueError("Argument `signals` must hold a channel, such as {'acceleration 0': a}, but is empty.")
        by_channel = {channel(name): _signal(str(name), values) for name, values in signals.items()}
        if len(by_channel) != len(signals):
            raise ValueError("Argument `signals` names one channel twice.")
        lengths = {str(name): len(values) for name, values in by_channel.items()}
        if len(set(lengths.values())) > 1:
            raise ValueError(f"Argument `signals` must hold signals of one length, but has {lengths}.")
        count = next(iter(lengths.values()))
        if count < SHORTEST:
            raise ValueError(f"Argument `signals` must hold at least {SHORTEST} samples, but has {count}.")
        self.t = _instants(t, count)
        self.channels = tuple(by_channel)
        self.values = np.stack(list(by_channel.values()), axis=1)
        self.regime, self.sampling, self.filter = str(regime), str(sampling), frequency_response(filter)
        for name, value in (("offset", offset), ("y0", y0)):
            if value is not None and regime != "kick":
                raise ValueError(
                    f'Argument `{name}` is for the regime "kick": in the regime "{regime}" no instant of the simulation is '
                    f"special. Leave it out."
                )
        self.y0 = None if y0 is None else _state(y0)
        self.offset = _offset(offset if offset is not None else (0.0, 0.5) if y0 is None else 0.0)
        if y0 is not None and self.offset[0] < 0:
            raise ValueError(
                f"Argument `offset` must not be negative with `y0`, which is the state at time 0, but is "
                f"{self.offset[0]:g}."
            )
        self.noise = None if noise is None else _noise(noise, self.channels)
        self.sticking, self.detached = _fraction("sticking", sticking, regime), _fraction("detached", detached, regime)
        for name, value in known.items():
            arguments.real_number(name, value)
        self.known = {name: float(value) for name, value in known.items()}

    @property
    def rate(self) -> float:
        """Samples per second."""
        return (len(self.t) - 1) / (self.t[-1] - self.t[0])

    @property
    def duration(self) -> float:
        """The number of samples times the time between them, in s."""
        return len(self.t) / self.rate


class Averaged(NamedTuple):
    """Means over blocks of samples. `edges`: the ends of the blocks, in s after the first sample; half a step before the first
    sample of each block.
    """

    edges: Float[np.ndarray, " edge"]
    means: Float[np.ndarray, "B k"]
    per_block: int


def averaged(recording: Recording, rate: float) -> Averaged:
    """A recording as means over blocks of samples, with about `rate` blocks per second and at least one sample in each.

    A last block that is not full is left out.
    """
    per_block = max(1, round(recording.rate / rate))
    blocks = len(recording.t) // per_block
    means = recording.values[: blocks * per_block].reshape(blocks, per_block, -1).mean(axis=1)
    edges = (np.arange(blocks + 1) * per_block - 0.5) / recording.rate
    return Averaged(edges, means, per_block)


def channel(name) -> Channel:
    """The channel of a name such as "acceleration 0", "velocity 1", "a0", "v_1" or "d 2".

    **Raises:** `ValueError` for any other name.
    """
    if isinstance(name, Channel):
        return name
    words = "displacement|velocity|acceleration|disp|vel|acc|d|v|a"
    match = re.fullmatch(rf"\s*({words})[\s_]*(\d+)\s*", str(name), re.IGNORECASE)
    if not match:
        raise ValueError(
            f"A channel must read `acceleration i`, `velocity i` or `displacement i` with the coordinate's number, such as "
            f"`acceleration 0`, but reads {str(name)!r}."
        )
    short = {"d": "displacement", "v": "velocity", "a": "acceleration"}
    return Channel(short[match[1][0].lower()], int(match[2]))


def _signal(name: str, values) -> np.ndarray:
    array = arguments.numeric_array(f"signals[{name!r}]", values).astype(np.float64)
    if array.ndim != 1:
        raise ValueError(f"Argument `signals[{name!r}]` must be one-dimensional, but has shape {array.shape}.")
    bad = np.flatnonzero(~np.isfinite(array))
    if bad.size:
        raise ValueError(f"Argument `signals[{name!r}]` must be finite, but sample {bad[0]} is {array[bad[0]]}.")
    return array


def _instants(t, count: int) -> np.ndarray:
    array = arguments.numeric_array("t", t).astype(np.float64)
    if array.ndim == 0:
        arguments.real_number("t", t, above=0)
        return np.arange(count) / float(array)
    if array.shape != (count,):
        raise ValueError(f"Argument `t` must hold {count} instants, one for each sample, but has shape {array.shape}.")
    steps = np.diff(array)
    if np.any(steps <= 0):
        at = int(np.argmax(steps <= 0))
        before, after = apart(*array[at : at + 2])
        raise ValueError(
            f"Argument `t` must be strictly increasing, but goes from {before} to {after} s after sample {at}. Sort the "
            "samples of all signals along with it (`numpy.argsort`), and drop those that repeat."
        )
    arguments.axis("t", array)
    step = (array[-1] - array[0]) / (count - 1)
    off = np.abs(steps - step)
    if off.max() > UNEVEN * step:
        at = int(np.argmax(off))
        own, mean = apart(steps[at], step)
        raise ValueError(
            f"Argument `t` must be evenly spaced, but its step is {own} s after sample {at} and {mean} s on "
            f"average. Interpolate the signals, or cut the recording at the gap."
        )
    return array


def _noise(noise, channels: tuple[Channel, ...]) -> Float[np.ndarray, " k"]:
    if not isinstance(noise, Mapping):
        arguments.real_number("noise", noise, above=0)
        return np.full(len(channels), float(noise))
    for name, value in noise.items():
        arguments.real_number(f"noise[{name!r}]", value, above=0)
    by_channel = {channel(name): float(value) for name, value in noise.items()}
    if len(by_channel) < len(noise):
        raise ValueError(f"Argument `noise` must name each channel once, but names {', '.join(map(str, noise))}.")
    missing = [str(one) for one in channels if one not in by_channel]
    if missing:
        raise ValueError(f"Argument `noise` must name every channel, but {missing[0]} is missing.")
    if other := [str(one) for one in by_channel if one not in channels]:
        raise ValueError(f"Argument `noise` names {other[0]}, which was not recorded.")
    return np.array([by_channel[one] for one in channels])


def _state(y0) -> Float[np.ndarray, " state"]:
    """A state as one array; `calibrate` checks it beside the scene."""
    parts = y0 if isinstance(y0, tuple | list) and len(y0) == 2 else (y0,)
    return np.concatenate([arguments.numeric_array("y0", part).astype(np.float64).ravel() for part in parts])


def _offset(offset) -> tuple[float, float]:
    array = arguments.numeric_array("offset", offset).astype(np.float64)
    if array.shape not in ((), (2,)):
        raise ValueError(f"Argument `offset` must be one number or a range of two, but has shape {array.shape}.")
    low, high = (float(array), float(array)) if array.ndim == 0 else map(float, array)
    if not (math.isfinite(low) and math.isfinite(high) and low <= high):
        raise ValueError(f"Argument `offset` must be finite and go up, but is ({', '.join(apart(low, high))}).")
    return low, high


def _fraction(name: str, value, regime: str) -> tuple[float, float] | None:
    if value is None:
        return None
    if regime != "limit cycle":
        raise ValueError(f'Argument `{name}` is for the regime "limit cycle", but the regime is "{regime}".')
    try:
        fraction, error = value
    except (TypeError, ValueError):
        raise ValueError(f"Argument `{name}` must be a pair of a fraction and its standard deviation.") from None
    arguments.real_number(f"{name}[0]", fraction, minimum=0, maximum=1)
    arguments.real_number(f"{name}[1]", error, above=0)
    return float(fraction), float(error)
