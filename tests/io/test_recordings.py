"""Recordings and the files they come from: read in SI units, and refused with the line or the variable named."""

from pathlib import Path

import numpy as np
import pytest
import scipy.io
from scipy.io import wavfile

import fivjax as fj
from fivjax.io.recordings import Channel, averaged

RATE = 1000.0
T = np.arange(40) / RATE
A = np.sin(400 * T)
V = np.cos(400 * T)


def csv(folder, text):
    path = folder / "run.csv"
    path.write_text(text, encoding="utf-8")
    return path


def table(head, rows, separator=","):
    return "\n".join([head, *(separator.join(f"{x:.12g}" for x in row) for row in rows)])


def test_csv_with_units(tmp_path):
    """A unit that is passed over is rejected: amplitudes would be wrong by its factor."""
    path = csv(tmp_path, table("t (ms),acceleration 0 (g),v1 [mm/s],note", zip(1e3 * T, A, V, T, strict=True)))
    found = fj.read_recording(path, "limit cycle", belt_speed=1.0)
    assert found.channels == (Channel("acceleration", 0), Channel("velocity", 1))
    np.testing.assert_allclose(found.t, T, atol=1e-12)
    np.testing.assert_allclose(found.values, np.stack([9.80665 * A, 1e-3 * V], axis=1), atol=1e-9)
    assert found.rate == pytest.approx(RATE) and found.duration == pytest.approx(0.04)
    assert found.known == {"belt_speed": 1.0} and found.regime == "limit cycle"


def test_csv_with_semicolons_and_decimal_commas(tmp_path):
    text = table("time;a0", zip(T, A, strict=True), ";").replace(".", ",")
    np.testing.assert_allclose(fj.read_recording(csv(tmp_path, "# from the rig\n" + text)).values[:, 0], A, atol=1e-9)


def test_numbers_in_quotes_and_units_in_greek_or_raised(tmp_path):
    """There are two letters that look like a micro, and a raised two."""
    rows = [('"' + '","'.join(f"{x:.12g}" for x in row) + '"') for row in zip(1e6 * T, A, strict=True)]
    for micro, two in (("\u03bc", "²"), ("\u00b5", "2"), ("u", "^2")):
        text = "\n".join([f'"t ({micro}s)","a0 (mm/s{two})"', *rows])
        found = fj.read_recording(csv(tmp_path, text))
        np.testing.assert_allclose(found.t, T, atol=1e-12)
        np.testing.assert_allclose(found.values[:, 0], 1e-3 * A, atol=1e-9)


def test_the_sample_recording_is_read():
    """The file that README and notebook fit: 0.8 s at 2 kHz of two accelerations, units in its names."""
    found = fj.read_recording(Path(__file__).parents[2] / "notebooks" / "decay.csv", "kick")
    assert found.channels == (Channel("acceleration", 0), Channel("acceleration", 1))
    assert found.rate == pytest.approx(2000) and found.duration == pytest.approx(0.8, rel=1e-3)
    assert len((Path(__file__).parents[2] / "notebooks" / "decay.csv").read_text()) < 50_000


def test_a_rate_that_contradicts_the_file_s_own_times_is_refused(tmp_path):
    path = csv(tmp_path, table("t,a0", zip(T, A, strict=True)))
    np.testing.assert_allclose(fj.read_recording(path, rate=RATE).t, T, atol=1e-12)
    with pytest.raises(ValueError, match=f"time base of its own, of {RATE:g} Hz, but `rate` is 1 Hz"):
        fj.read_recording(path, rate=1.0)


def test_noise_by_channel_or_one_for_all():
    assert fj.Recording(T, {"a0": A, "v1": V}, noise=0.2).noise.tolist() == [0.2, 0.2]
    assert fj.Recording(T, {"a0": A, "v1": V}, noise={"v1": 0.1, "a0": 0.3}).noise.tolist() == [0.3, 0.1]
    with pytest.raises(ValueError, match="names acceleration 5, which was not recorded"):
        fj.Recording(T, {"a0": A}, noise={"a0": 0.1, "a5": 0.3})
    with pytest.raises(ValueError, match="each channel once, but names a0, acceleration 0"):
        fj.Recording(T, {"a0": A}, noise={"a0": 0.1, "acceleration 0": 0.3})


def test_columns_by_name(tmp_path):
    path = csv(tmp_path, table("clock,Acc X", zip(T, A, strict=True)))
    found = fj.read_recording(path, columns={"Acc X": "acceleration 0"}, time="clock", units={"Acc X": "mm/s2"})
    np.testing.assert_allclose(found.values[:, 0], 1e-3 * A, atol=1e-12)
    # A unit that is given for no column would be of no use.
    with pytest.raises(ValueError, match="no variable `acc x`; it has: clock, Acc X"):
        fj.read_recording(path, columns={"Acc X": "a0"}, time="clock", units={"acc x": "mm/s2"})
    for wrong in ({"units": "g"}, {"columns": ["Acc X"]}):
        with pytest.raises(TypeError, match=f"`{next(iter(wrong))}` must be a dictionary"):
            fj.read_recording(path, time="clock", **wrong)


def test_numpy_and_matlab_and_wav(tmp_path):
    """The same signal from every format."""
    np.savez(tmp_path / "run.npz", t=T, a0=A)
    np.save(tmp_path / "run.npy", np.stack([T, A], axis=1))
    scipy.io.savemat(tmp_path / "run.mat", {"time": T, "a0": A, "remark": "rig 3"})
    wavfile.write(tmp_path / "run.wav", int(RATE), np.round(A * 32767).astype(np.int16))
    wavfile.write(tmp_path / "float.wav", int(RATE), A.astype(np.float32))
    named = {"columns": {"1": "acceleration 0"}, "time": "0"}
    track = {"columns": {"0": "acceleration 0"}}
    for name, options, rounding in (
        ("run.npz", {}, 0),
        ("run.npy", named, 0),
        ("run.mat", {}, 0),
        ("run.wav", track, 1e-4),
        ("float.wav", track, 1e-6),
    ):
        found = fj.read_recording(tmp_path / name, **options)
        np.testing.assert_allclose(found.values[:, 0], A, atol=1e-12 + rounding)
        assert found.rate == pytest.approx(RATE)
    assert fj.read_recording(tmp_path / "run.wav", full_scale=50.0, **track).values.max() == pytest.approx(50, rel=1e-2)


def test_blocks_are_means_and_their_edges_lie_between_samples():
    """A mean of accelerations over a block is the change of velocity between its edges, on any signal: the model relies on it."""
    rate, frequency = 25_000.0, 68.0
    edges = np.arange(2001) / rate
    velocity = np.sin(2 * np.pi * frequency * edges)
    found = averaged(fj.Recording(rate, {"a0": np.diff(velocity) * rate}), 1100.0)
    assert found.per_block == 23 and len(found.means) == 2000 // 23
    np.testing.assert_allclose(found.edges[0], -0.5 / rate)
    # Edges count from the middle of the first sample, half a step after the first velocity.
    at = np.sin(2 * np.pi * frequency * (found.edges + 0.5 / rate))
    np.testing.assert_allclose(found.means[:, 0], np.diff(at) / np.diff(found.edges), rtol=1e-9, atol=1e-9)


BAD_FILES = [
    ("t,a0\n0,1\n0.1,x\n", ["line 3", "`a0`", "'x'"]),
    ("t,a0\n0,1\n0.1,2,3\n", ["line 3", "2 numbers expected, 3 found"]),
    ("t,a0\n0,1\n0.1,nan\n", ["line 3", "`a0`", "finite"]),
    ('a0\n1\n""\n2\n', ["line 3", "`a0`", "''"]),
    ('t,a0\n0,1\n0.1,1"2\n', ["line 3", "`a0`", '1"2']),
    ("0,1\n0.1,2\n", ["line 1", "names"]),
    ("t,t,a0\n0,1,2\n", ["line 1", "`t`", "twice"]),
    ("t,b\n0,1\n0.1,2\n", ["no channel", "t, b", "`columns`"]),
    ("x,a0\n0,1\n0.1,2\n", ["no column `t`", "`rate`"]),
    ("t,a0 (furlong)\n0,1\n0.1,2\n", ["`a0`", "'furlong'", "m/s2"]),
    ("t,a0\n", ["1 lines"]),
    ("t,a0\n0,1\n", ["at least 16 samples", "has 1"]),
]


@pytest.mark.parametrize(("text", "fragments"), BAD_FILES, ids=[fragments[0] for _, fragments in BAD_FILES])
def test_bad_csv(tmp_path, text, fragments):
    """Each is refused with its line: a fit would run on numbers that were not measured."""
    with pytest.raises(ValueError, match=r"run\.csv") as refusal:
        fj.read_recording(csv(tmp_path, text))
    for fragment in fragments:
        assert fragment in str(refusal.value)


def test_bad_binary_files(tmp_path):
    for name in ("run.npy", "run.npz", "run.wav", "run.mat"):
        (tmp_path / name).write_bytes(b"no such thing")
        with pytest.raises(ValueError, match=f"{name}` cannot be read"):
            fj.read_recording(tmp_path / name)
    scipy.io.savemat(tmp_path / "run.mat", {"t": T, "a0": np.stack([A, A])})
    with pytest.raises(ValueError, match=r"variable `a0`: must be a vector"):
        fj.read_recording(tmp_path / "run.mat")
    np.savez(tmp_path / "run.npz", t=T, a0=np.where(T > 0.01, np.nan, A))
    with pytest.raises(ValueError, match=r"variable `a0`: must be finite, but sample 11"):
        fj.read_recording(tmp_path / "run.npz")
    with pytest.raises(ValueError, match="does not exist"):
        fj.read_recording(tmp_path / "none.csv")
    with pytest.raises(ValueError, match="must be one of"):
        fj.read_recording(tmp_path / "run.xlsx")


@pytest.mark.parametrize(
    ("make", "fragments"),
    [
        (lambda: fj.Recording(T, {}), ["`signals`"]),
        (lambda: fj.Recording(T, {"x": A}), ["acceleration i", "'x'"]),
        (lambda: fj.Recording(T, {"a0": A, "acceleration 0": A}), ["twice"]),
        (lambda: fj.Recording(T, {"a0": A, "a1": A[1:]}), ["one length", "39"]),
        (lambda: fj.Recording(T[:8], {"a0": A[:8]}), ["at least 16", "8"]),
        (lambda: fj.Recording(T[1:], {"a0": A}), ["`t`", "40", "(39,)"]),
        (lambda: fj.Recording(np.where(T > 0.02, T + 0.1, T), {"a0": A}), ["evenly spaced", "sample 20"]),
        (lambda: fj.Recording(T[::-1], {"a0": A}), ["`t`", "strictly increasing"]),
        (lambda: fj.Recording(T, {"a0": A}, "squeal"), ["`regime`", '"limit cycle"', "'squeal'"]),
        (lambda: fj.Recording(T, {"a0": A}, "sliding", offset=0.1), ["`offset`", '"kick"']),
        (lambda: fj.Recording(T, {"a0": A}, offset=(0.5, 0.1)), ["`offset`", "go up"]),
        (lambda: fj.Recording(T, {"a0": A}, noise={"a1": 1.0}), ["`noise`", "acceleration 0"]),
        (lambda: fj.Recording(T, {"a0": A}, sticking=(0.1, 0.01)), ["`sticking`", '"limit cycle"']),
        (lambda: fj.Recording(T, {"a0": A}, "limit cycle", sticking=0.1), ["`sticking`", "pair"]),
        (lambda: fj.Recording(T, {"a0": A}, belt_speed="fast"), ["`belt_speed`", "'fast'"]),
    ],
)
def test_bad_recordings(make, fragments):
    """Each is a sentence that names the argument."""
    with pytest.raises((ValueError, TypeError)) as refusal:
        make()
    for fragment in fragments:
        assert fragment in str(refusal.value)


def test_what_is_read_from_the_file_is_not_given(tmp_path):
    path = csv(tmp_path, table("t,a0", zip(T, A, strict=True)))
    with pytest.raises(TypeError, match="Argument `t` is read from the file"):
        fj.read_recording(path, t=T)


def test_two_columns_of_one_channel_are_refused(tmp_path):
    path = csv(tmp_path, table("t,a0,acceleration 0", zip(T, A, A, strict=True)))
    with pytest.raises(
        ValueError, match="the columns `a0` and `acceleration 0` are both of the channel `acceleration 0`"
    ):
        fj.read_recording(path)
    assert fj.read_recording(path, columns={"a0": "a0"}).values.shape[1] == 1


def test_t_is_the_time_where_there_is_another_t(tmp_path):
    path = csv(tmp_path, table("T,t,a0", zip(100 * T, T, A, strict=True)))
    np.testing.assert_allclose(fj.read_recording(path).t, T, atol=1e-9)
