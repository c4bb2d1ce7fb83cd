"""Recordings: what was measured, with its time base, its units and what is known of the run it came from.

A recording is read from a file (`read_recording`) or made from arrays (`Recording`), and averaged over blocks of samples
before it is compared with a model (`averaged`). Over a block a mean acceleration is a change of velocity and a mean
velocity a change of displacement, so the model is averaged *exactly*, whatever jumps inside the block. Picking single
samples would not do: where the contact changes, accelerations jump, and a sum over picked samples has the wrong
derivative.
"""

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import h5py
import numpy as np
import scipy.io
from jaxtyping import Float
from scipy.io import wavfile

from ..foundation import arguments

REGIMES = ("sliding", "kick", "limit cycle")
QUANTITIES = ("acceleration", "velocity")
UNITS = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6},
    "acceleration": {
        "m/s2": 1.0,
        "m/s^2": 1.0,
        "m/s²": 1.0,
        "mm/s2": 1e-3,
        "mm/s^2": 1e-3,
        "mm/s²": 1e-3,
        "g": 9.80665,
    },
    "velocity": {"m/s": 1.0, "mm/s": 1e-3, "cm/s": 1e-2},
}
# Time stamps are written with few digits; steps that differ by more than this share of a step are not rounding.
UNEVEN = 0.05
SHORTEST = 16


class Channel(NamedTuple):
    """One measured signal: "acceleration" or "velocity" of one coordinate of the structure."""

    quantity: str
    coordinate: int

    def __str__(self) -> str:
        return f"{self.quantity} {self.coordinate}"


class Recording(eqx.Module):
    """Signals of one run, evenly sampled, in SI units.

        fj.Recording(t, {"acceleration 0": a_x, "acceleration 1": a_y}, "kick", belt_speed=3.0, p=1.2)

    **Arguments:**

    - `t`: `(T,)` instants in s, evenly spaced, or one number: the sampling rate in Hz.
    - `signals`: `(T,)` arrays by channel, "acceleration i" (m/s²) or "velocity i" (m/s) of coordinate i.
    - `regime`: what was recorded.
      "sliding": a small motion about steady sliding, growing or decaying, whatever set it off.
      "kick": the response to the scene's own load from steady sliding; any contact events.
      "limit cycle": a vibration that keeps its amplitude.
    - `offset`: for a kick, the instant of the simulation (s after its start) at which the recording's first sample lies,
      as one number if known, else as the range to look in: (0, 0.5) unless given. A recording that begins before the
      simulation has a negative offset.
    - `noise`: standard deviation of one sample by channel, estimated from what the fit leaves unless given.
    - `sticking`, `detached`: for a limit cycle, the measured fractions of time in these statuses, as pairs of the value
      and its standard deviation.
    - `known`: parameters of the scene that were different in this run, by name: `belt_speed=1.0, force=50.0`.

    **Raises:** `ValueError` or `TypeError`, as a sentence, for signals that are not finite, not evenly sampled, of unequal
    length or shorter than 16 samples, and for names that mean nothing.
    """

    t: Float[np.ndarray, " T"]
    values: Float[np.ndarray, "T k"]
    channels: tuple[Channel, ...] = eqx.field(static=True)
    regime: str = eqx.field(static=True)
    offset: tuple[float, float]
    noise: Float[np.ndarray, " k"] | None
    sticking: tuple[float, float] | None
    detached: tuple[float, float] | None
    known: dict[str, float]

    def __init__(
        self,
        t,
        signals: Mapping,
        regime: str = "kick",
        *,
        offset=None,
        noise: Mapping | None = None,
        sticking: tuple[float, float] | None = None,
        detached: tuple[float, float] | None = None,
        **known,
    ):
        arguments.one_of("regime", regime, REGIMES)
        if not isinstance(signals, Mapping) or not signals:
            raise TypeError(
                f"Argument `signals` must map channels to arrays, such as {{'acceleration 0': a}}, but is "
                f"{arguments.describe(signals)}."
            )
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
        self.regime = regime
        if offset is not None and regime != "kick":
            raise ValueError(
                f'Argument `offset` is for the regime "kick": in the regime "{regime}" no instant of the simulation is '
                f"special. Leave it out."
            )
        self.offset = _offset((0.0, 0.5) if offset is None else offset)
        by_name: dict = {}
        if noise is not None:
            for name, value in noise.items():
                arguments.real_number(f"noise[{name!r}]", value, above=0)
            missing = [str(c) for c in by_channel if c not in {channel(name) for name in noise}]
            if missing:
                raise ValueError(f"Argument `noise` must name every channel, but {missing[0]} is missing.")
            by_name = {channel(name): float(value) for name, value in noise.items()}
        self.noise = None if noise is None else np.array([by_name[c] for c in by_channel])
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
        """Time that the samples cover, each its own step, in s."""
        return len(self.t) / self.rate


class Averaged(NamedTuple):
    """Means over blocks of samples. `edges` are s after the first sample, half a step before each block's first one."""

    edges: Float[np.ndarray, " B+1"]
    means: Float[np.ndarray, "B k"]
    per_block: int


def averaged(recording: Recording, rate: float) -> Averaged:
    """A recording as means over blocks of as many samples as come closest to `rate` blocks per second, one at least.

    A last block that is not full is left out.
    """
    per_block = max(1, round(recording.rate / rate))
    blocks = len(recording.t) // per_block
    means = recording.values[: blocks * per_block].reshape(blocks, per_block, -1).mean(axis=1)
    edges = (np.arange(blocks + 1) * per_block - 0.5) / recording.rate
    return Averaged(edges, means, per_block)


def channel(name) -> Channel:
    """The channel that a name means: "acceleration 0", "velocity 1", "a0", "v_1" …

    **Raises:** `ValueError` for any other name.
    """
    if isinstance(name, Channel):
        return name
    match = re.fullmatch(r"\s*(acceleration|velocity|acc|vel|a|v)[\s_]*(\d+)\s*", str(name), re.IGNORECASE)
    if not match:
        raise ValueError(
            f"A channel must read `acceleration i` or `velocity i` with the coordinate's number, such as "
            f"`acceleration 0`, but reads {str(name)!r}."
        )
    return Channel("acceleration" if match[1].lower().startswith("a") else "velocity", int(match[2]))


def read_recording(
    path: str | Path,
    regime: str = "kick",
    *,
    columns: Mapping[str, str] | None = None,
    time: str | None = None,
    rate: float | None = None,
    units: Mapping[str, str] | None = None,
    full_scale: float = 1.0,
    **about,
) -> Recording:
    """A recording from a file: `.csv`/`.txt`, `.npy`/`.npz`, `.wav` or `.mat`.

        fj.read_recording("squeal.csv", "limit cycle", belt_speed=1.0)
        fj.read_recording("squeal.wav", columns={"0": "acceleration 0"}, full_scale=500.0)

    - CSV: commas, semicolons or tabs; one line of names, then numbers. A unit may follow a name in brackets: `t (ms)`.
    - NumPy: arrays by name (`.npz`, or a structured `.npy`); columns of a plain array are named "0", "1", …
    - WAV: tracks are named "0", "1", …; `full_scale` is what the largest sample means, in the channel's unit.
    - MATLAB: vectors by name.

    **Arguments:**

    - `regime` and what else is passed on: see `Recording`.
    - `columns`: which column is which channel; unless given, those are taken whose names say so (`channel`).
    - `time`: the name of the time base ("t" or "time" unless given); or `rate`, the sampling rate in Hz. WAV has its own.
    - `units`: by the file's names; they go before the file's own. Without either, SI.

    **Raises:** `ValueError` naming the file with the line, or the variable, that cannot be used.
    """
    path = Path(path)
    readers = {".csv": _csv, ".txt": _csv, ".npy": _numpy, ".npz": _numpy, ".wav": _wav, ".mat": _matlab}
    if path.suffix.lower() not in readers:
        raise ValueError(
            f"File `{path}` must be one of {', '.join(readers)}, but ends in {path.suffix or 'nothing'!r}."
        )
    if not path.is_file():
        raise ValueError(f"File `{path}` does not exist.")
    arguments.real_number("full_scale", full_scale, above=0)
    if rate is not None:
        arguments.real_number("rate", rate, above=0)
    found, own_units, own_rate = readers[path.suffix.lower()](path)
    units = {**own_units, **(units or {})}
    scale = full_scale if path.suffix.lower() == ".wav" else 1.0
    if columns is None:
        columns = {name: name for name in found if _is_channel(name)}
        if not columns:
            raise ValueError(
                f"File `{path}` names no channel such as `acceleration 0`; it has: {', '.join(found)}. Say which is "
                f"which with `columns`."
            )
    for name in columns:
        _must_have(path, found, name)
    signals = {}
    for name, meaning in columns.items():
        unit = _unit(path, name, channel(meaning).quantity, units)
        signals[channel(meaning)] = scale * unit * _vector(path, name, found[name])
    rate = own_rate if rate is None else rate
    if rate is None:
        time = next((name for name in found if name.lower() in ("t", "time")), None) if time is None else time
        if time is None:
            raise ValueError(f"File `{path}` has no column `t` or `time`; name it with `time`, or give `rate` in Hz.")
        _must_have(path, found, time)
        base = _unit(path, time, "time", units) * _vector(path, time, found[time])
    else:
        base = float(rate)
    try:
        return Recording(base, signals, regime, **about)
    except ValueError as error:
        raise ValueError(f"File `{path}`: {error}") from None


def _csv(path: Path):
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise ValueError(f"File `{path}` is not text: byte {error.start} is no UTF-8.") from None
    rows = [
        (number, line) for number, line in enumerate(lines, 1) if line.strip() and not line.lstrip().startswith("#")
    ]
    if len(rows) < 2:
        raise ValueError(f"File `{path}` must hold a line of names and lines of numbers, but has {len(rows)} lines.")
    (first, head), *rows = rows
    separator = next((s for s in (";", "\t", ",") if s in head), ",")
    names, units = [], {}
    for text in head.split(separator):
        match = re.fullmatch(r"(.*?)\s*(?:[(\[](.*?)[)\]])?", text.strip().strip('"'))
        name = match[1] if match else text
        if _is_number(name):
            raise ValueError(f"File `{path}`, line {first}: a line of names must come first, but it holds {name!r}.")
        if name in names:
            raise ValueError(f"File `{path}`, line {first}: the name `{name}` is there twice.")
        names.append(name)
        if match and match[2]:
            units[name] = match[2]
    table = np.empty((len(rows), len(names)))
    for row, (number, line) in enumerate(rows):
        entries = line.split(separator)
        if len(entries) != len(names):
            raise ValueError(f"File `{path}`, line {number}: {len(names)} numbers expected, {len(entries)} found.")
        for column, entry in enumerate(entries):
            # A decimal comma is unmistakable where commas do not separate.
            text = entry.strip().replace(",", ".") if separator != "," else entry.strip()
            try:
                table[row, column] = float(text)
            except ValueError:
                raise ValueError(
                    f"File `{path}`, line {number}, column `{names[column]}`: {entry.strip()!r} is no number."
                ) from None
            if not math.isfinite(table[row, column]):
                raise ValueError(
                    f"File `{path}`, line {number}, column `{names[column]}`: must be finite, but is {entry.strip()}."
                )
    return dict(zip(names, table.T, strict=True)), units, None


def _numpy(path: Path):
    try:
        loaded = np.load(path, allow_pickle=False)
        if isinstance(loaded, np.ndarray):
            if loaded.dtype.names:
                return {name: loaded[name] for name in loaded.dtype.names}, {}, None
            if loaded.ndim not in (1, 2):
                raise ValueError(f"it has shape {loaded.shape}, not (T,) or (T, k)")
            table = loaded.reshape(len(loaded), -1)
            return {str(k): table[:, k] for k in range(table.shape[1])}, {}, None
        with loaded:
            return {name: loaded[name] for name in loaded.files}, {}, None
    except (ValueError, OSError, EOFError) as error:
        raise ValueError(f"File `{path}` cannot be read as NumPy: {str(error).rstrip('.')}.") from None


def _wav(path: Path):
    try:
        rate, samples = wavfile.read(path)
    except (ValueError, OSError, EOFError) as error:
        raise ValueError(f"File `{path}` cannot be read as WAV: {str(error).rstrip('.')}.") from None
    # Unsigned samples (8 bit) rest at 128; 24 bits come in the upper part of 32.
    if samples.dtype.kind == "u":
        samples = (samples.astype(float) - 128.0) / 128.0
    elif samples.dtype.kind == "i":
        samples = samples.astype(float) / (np.iinfo(samples.dtype).max + 1.0)
    table = samples.reshape(len(samples), -1)
    return {str(k): table[:, k] for k in range(table.shape[1])}, {}, float(rate)


def _matlab(path: Path):
    # The reader of MATLAB files has errors of its own kind beside these.
    unreadable = (ValueError, TypeError, OSError, EOFError, scipy.io.matlab.MatReadError)
    try:
        loaded = scipy.io.loadmat(path, squeeze_me=True)
    except NotImplementedError:  # version 7.3 is HDF5
        with h5py.File(path) as file:
            loaded = {name: np.squeeze(item[()]) for name, item in file.items() if isinstance(item, h5py.Dataset)}
    except unreadable as error:
        raise ValueError(f"File `{path}` cannot be read as MATLAB: {str(error).rstrip('.')}.") from None
    return {name: value for name, value in loaded.items() if not name.startswith("__")}, {}, None


def _vector(path: Path, name: str, values) -> np.ndarray:
    array = np.squeeze(np.asarray(values))
    if array.dtype.kind not in "iuf" or array.ndim != 1:
        raise ValueError(
            f"File `{path}`, variable `{name}`: must be a vector of real numbers, but is {arguments.describe(array)}."
        )
    bad = np.flatnonzero(~np.isfinite(array))
    if bad.size:
        raise ValueError(f"File `{path}`, variable `{name}`: must be finite, but sample {bad[0]} is {array[bad[0]]}.")
    return array.astype(np.float64)


def _unit(path: Path, name: str, quantity: str, units: Mapping[str, str]) -> float:
    unit = units.get(name)
    if unit is None:
        return 1.0
    if unit.strip() not in UNITS[quantity]:
        raise ValueError(
            f"File `{path}`, variable `{name}`: {unit!r} is no unit of {quantity}; known are {', '.join(UNITS[quantity])}."
        )
    return UNITS[quantity][unit.strip()]


def _must_have(path: Path, found: Mapping, name: str) -> None:
    if name not in found:
        raise ValueError(f"File `{path}` has no variable `{name}`; it has: {', '.join(found)}.")


def _is_channel(name: str) -> bool:
    try:
        channel(name)
    except ValueError:
        return False
    return True


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


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
    array = arguments.axis("t", array)
    steps = np.diff(array)
    step = (array[-1] - array[0]) / (count - 1)
    off = np.abs(steps - step)
    if off.max() > UNEVEN * step:
        at = int(np.argmax(off))
        raise ValueError(
            f"Argument `t` must be evenly spaced, but its step is {steps[at]:g} s after sample {at} and {step:g} s on "
            f"average. Interpolate the signals, or cut the recording at the gap."
        )
    return array


def _offset(offset) -> tuple[float, float]:
    array = arguments.numeric_array("offset", offset).astype(np.float64)
    if array.shape not in ((), (2,)):
        raise ValueError(f"Argument `offset` must be one number or a range of two, but has shape {array.shape}.")
    low, high = (float(array), float(array)) if array.ndim == 0 else map(float, array)
    if not (math.isfinite(low) and math.isfinite(high) and low <= high):
        raise ValueError(f"Argument `offset` must be finite and go up, but is ({low:g}, {high:g}).")
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
