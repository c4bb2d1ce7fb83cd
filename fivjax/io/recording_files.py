"""Recordings from files: formats and units. Errors name the line or the variable."""

import io
import math
import re
import unicodedata
import warnings
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ..foundation import arguments
from .files import check_there
from .matlab_files import read_matlab
from .numpy_files import load_archive, load_array
from .reading_limits import check_length, unreadable
from .recordings import Recording, channel

# Columns of a table, and characters of a name.
MOST_TRACKS, LONGEST_NAME = 10_000, 200
UNITS = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "μs": 1e-6},
    "acceleration": {"m/s2": 1.0, "m/s^2": 1.0, "mm/s2": 1e-3, "mm/s^2": 1e-3, "g": 9.80665},
    "velocity": {"m/s": 1.0, "mm/s": 1e-3, "cm/s": 1e-2},
    "displacement": {"m": 1.0, "mm": 1e-3, "um": 1e-6, "μm": 1e-6, "cm": 1e-2},
}


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

    - `regime` and any further arguments: see `Recording`.
    - `columns`: the channel of each column, by the file's names; unless given, all columns whose name is that of a channel
      ("acceleration 0", "velocity 1", "a0", "v_1", …).
    - `time`: the name of the time base ("t" or "time" unless given); or `rate`, the sampling rate in Hz. WAV files have theirs.
    - `units`: by the file's names; they override those in the file. Without either, SI.

    **Raises:** `ValueError` naming the file with the line, or the variable, that cannot be used.

    **Example:**

        >>> data = fj.read_recording("decay.csv", "kick", offset=(0.0, 0.2))
        >>> [(channel.quantity, channel.coordinate) for channel in data.channels]
        [('acceleration', 0), ('acceleration', 1)]
    """
    path = arguments.path("path", path)
    readers = {".csv": _csv, ".txt": _csv, ".npy": _numpy, ".npz": _numpy, ".wav": _wav, ".mat": _matlab}
    if path.suffix.lower() not in readers:
        ending = repr(path.suffix) if path.suffix else "none of them"
        raise ValueError(f"File `{path}` must be one of {', '.join(readers)}, but ends in {ending}.")
    check_there(path)
    arguments.real_number("full_scale", full_scale, above=0)
    if rate is not None:
        arguments.real_number("rate", rate, above=0)
    units = arguments.by_name("units", units, '"a0": "g"')
    columns = None if columns is None else arguments.by_name("columns", columns, '"Acc_X": "acceleration 0"')
    found, own_units, own_rate = readers[path.suffix.lower()](path)
    scale = full_scale if path.suffix.lower() == ".wav" else 1.0
    if columns is None:
        columns = {name: name for name in found if _is_channel(name)}
        if not columns:
            raise ValueError(
                f"File `{path}` names no channel such as `acceleration 0`; it has: {', '.join(found)}. Say which is "
                f"which with `columns`."
            )
    for name in (*columns, *units):
        _must_have(path, found, name)
    units = {**own_units, **units}
    signals, named = {}, {}
    for name, meaning in columns.items():
        if (before := named.setdefault(channel(meaning), name)) != name:
            raise ValueError(
                f"File `{path}`: the columns `{before}` and `{name}` are both of the channel `{channel(meaning)}`. Say which "
                f"one counts with `columns`."
            )
        unit = _unit(path, name, channel(meaning).quantity, units)
        signals[channel(meaning)] = scale * unit * _vector(path, name, found[name])
    if time is None:
        time = next((name for name in ("t", "time", *found) if name in found and name.lower() in ("t", "time")), None)
    if own_rate is not None:
        base = float(own_rate)
    elif time is not None:
        _must_have(path, found, time)
        base = _unit(path, time, "time", units) * _vector(path, time, found[time])
    elif rate is not None:
        base = float(rate)
    else:
        raise ValueError(f"File `{path}` has no column `t` or `time`; name it with `time`, or give `rate` in Hz.")
    if own := {"t", "signals"} & set(about):
        raise TypeError(
            f"Argument `{min(own)}` is read from the file. Name its time base with `time`, and its channels with `columns`."
        )
    try:
        recording = Recording(base, signals, regime, **about)
    except ValueError as error:
        raise ValueError(f"File `{path}`: {error}") from None
    # They may differ by rounding of what is written in files.
    if rate is not None and not np.isclose(recording.rate, rate, rtol=1e-2):
        raise ValueError(
            f"File `{path}` has a time base of its own, of {recording.rate:g} Hz, but `rate` is {rate:g} Hz. Leave out `rate`; "
            f"if the file's times are wrong, correct them there."
        )
    return recording


def _csv(path: Path):
    check_length(path)
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
    heads = head.split(separator)
    if len(heads) > MOST_TRACKS or max(map(len, heads)) > LONGEST_NAME:
        raise ValueError(
            f"File `{path}`, line {first}: a line of names must come first, at most {MOST_TRACKS} of at most {LONGEST_NAME} "
            f"characters, but it holds {len(heads)}, the longest of {max(map(len, heads))}."
        )
    for text in heads:
        match = re.fullmatch(r"(.*?)\s*(?:[(\[](.*?)[)\]])?", text.strip().strip('"'))
        name = match[1] if match else text
        if _is_number(name):
            raise ValueError(f"File `{path}`, line {first}: a line of names must come first, but it holds {name!r}.")
        if name in names:
            raise ValueError(f"File `{path}`, line {first}: the name `{name}` is there twice.")
        names.append(name)
        if match and match[2]:
            units[name] = match[2]
    # Before room is made for all: a long first line and many short ones would ask for more than the file can fill.
    for number, line in rows:
        if (found := line.count(separator) + 1) != len(names):
            raise ValueError(f"File `{path}`, line {number}: {len(names)} numbers expected, {found} found.")
    # A comma can only be a decimal comma where it is not the separator.
    if separator != ",":
        rows = [(number, line.replace(",", ".")) for number, line in rows]
    rows = [
        (number, separator.join(map(_unquoted, line.split(separator))) if '"' in line else line)
        for number, line in rows
    ]
    try:
        table = np.loadtxt([line for _, line in rows], delimiter=separator, comments=None, ndmin=2)
    except ValueError:
        table = np.zeros(0)
    # It leaves out empty lines.
    if len(table) != len(rows) or not np.all(np.isfinite(table)):
        table = np.array([_numbers(path, number, names, line.split(separator)) for number, line in rows])
    return dict(zip(names, table.T, strict=True)), units, None


def _unquoted(entry: str) -> str:
    entry = entry.strip()
    return entry[1:-1] if len(entry) > 1 and entry[0] == entry[-1] == '"' else entry


def _numbers(path: Path, line: int, names: list[str], entries: list[str]) -> list[float]:
    """The numbers of a line, one by one: the first that is none is named."""
    found = []
    for name, entry in zip(names, map(str.strip, entries), strict=True):
        try:
            # Python takes underscores between digits, too.
            found.append(float(entry.replace("_", "no number")))
        except ValueError:
            raise ValueError(f"File `{path}`, line {line}, column `{name}`: {entry[:60]!r} is no number.") from None
        if not math.isfinite(found[-1]):
            raise ValueError(f"File `{path}`, line {line}, column `{name}`: must be finite, but is {entry[:60]}.")
    return found


def _numpy(path: Path):
    if path.suffix.lower() == ".npz":
        return load_archive(path), {}, None
    loaded = load_array(path)
    if loaded.dtype.names:
        return {name: loaded[name] for name in loaded.dtype.names}, {}, None
    if loaded.ndim not in (1, 2) or not len(loaded):
        raise unreadable(path, "NumPy", f"it has shape {loaded.shape}, not (T,) or (T, k)")
    return _tracks(path, "NumPy", loaded.reshape(len(loaded), -1)), {}, None


def _wav(path: Path):
    from scipy.io import wavfile

    check_length(path)
    content = path.read_bytes()
    try:
        with warnings.catch_warnings(action="error"):
            warnings.filterwarnings("ignore", "Chunk .* not understood")
            if content[4:8] == b"\xff" * 4:  # written as it was recorded, its length not known
                warnings.filterwarnings("ignore", "Reached EOF prematurely")
            rate, samples = wavfile.read(io.BytesIO(content))
    except ZeroDivisionError:
        raise unreadable(path, "WAV", "it declares 0 tracks") from None
    except UnboundLocalError:
        raise unreadable(path, "WAV", "it has no format, or no samples") from None
    except Exception as error:  # what the library raises for damaged files, of many kinds
        raise unreadable(path, "WAV", error) from None
    if not samples.size:
        raise unreadable(path, "WAV", "it has no samples")
    with np.errstate(invalid="ignore"):  # what is no number is refused with its place
        scaled = np.asarray(samples, float)
    if samples.dtype.kind == "u":  # it rests at 128
        scaled = (scaled - 128.0) / 128.0
    elif samples.dtype.kind == "i":
        scaled = scaled / 2.0 ** (8 * samples.dtype.itemsize - 1)
    return _tracks(path, "WAV", scaled.reshape(len(scaled), -1)), {}, rate


def _matlab(path: Path):
    return read_matlab(path), {}, None


def _tracks(path: Path, kind: str, table: np.ndarray) -> dict[str, np.ndarray]:
    if table.shape[1] > MOST_TRACKS:
        raise unreadable(path, kind, f"it has {table.shape[1]} tracks; the most is {MOST_TRACKS}")
    return {str(k): table[:, k] for k in range(table.shape[1])}


def _vector(path: Path, name: str, values) -> np.ndarray:
    # A single sample keeps its axis: that there are too few is said of the recording.
    array = np.atleast_1d(np.squeeze(np.asarray(values)))
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
    # There are two letters µ that look the same, and digits that are raised: ² is 2.
    plain = unicodedata.normalize("NFKC", unit).strip() if isinstance(unit, str) else None
    if plain not in UNITS[quantity]:
        raise ValueError(
            f"File `{path}`, variable `{name}`: {unit!r} is no unit of {quantity}; known are {', '.join(UNITS[quantity])}."
        )
    return UNITS[quantity][plain]


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
