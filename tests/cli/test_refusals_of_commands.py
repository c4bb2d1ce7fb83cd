"""Bad input at every other command, and at the functions behind them: a sentence, exit code 2, and nothing written."""

import numpy as np
import pytest
import xarray as xr

import fivjax as fj
from fivjax import cli
from fivjax.maps import checkpoint
from tests.helpers.refusing import EngineReached, refused, refused_on_the_command_line, untouched, without_engines

T = np.arange(64) * 1e-3
A = np.sin(400.0 * T)


@pytest.fixture(autouse=True)
def no_engine(monkeypatch):
    """Makes it an error to reach an engine: bad input is refused before a minute of compiling, not after it."""
    without_engines(monkeypatch)


def text(rows=64, header="t,acceleration 0", change=lambda rows: rows) -> str:
    lines = [f"{t:.6f},{a:.6f}" for t, a in zip(T[:rows], A[:rows], strict=True)]
    return "\n".join([header, *change(lines)]) + "\n"


FILES = {
    "good.csv": text(),
    "short.csv": text(8),
    "empty.csv": "",
    "names.csv": text(header="t,x"),
    "timeless.csv": text(header="x,acceleration 0"),
    "twice.csv": text(header="acceleration 0,acceleration 0"),
    "nan.csv": text(change=lambda rows: [*rows[:9], "0.009,nan", *rows[10:]]),
    "word.csv": text(change=lambda rows: [*rows[:9], "0.009,loud", *rows[10:]]),
    "ragged.csv": text(change=lambda rows: [*rows[:9], "0.009,1,2", *rows[10:]]),
    "gap.csv": text(change=lambda rows: [*rows[:9], *rows[20:]]),
    "back.csv": text(change=lambda rows: rows[::-1]),
    "unit.csv": text(header="t,acceleration 0 (furlong)"),
    "far.csv": text(header="t,acceleration 7"),
    "normal.csv": text(header="t,acceleration 2"),
    "broken.npy": "not an array",
    "broken.wav": "not a sound",
    "broken.mat": "not a matrix",
    "sheet.xlsx": "anything",
}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    for name, content in FILES.items():
        (tmp_path / name).write_text(content)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_commands_here_reach_the_engine_with_good_input(folder):
    """Good input reaches the stand-ins for the engines; if it did not, the tests below would prove nothing."""
    for command in (["calibrate", "good.csv", "--free", "mu", "--rate", "1000"], ["tradeoff", "--t1", "0.1"]):
        with pytest.raises(EngineReached):
            cli.main([*command, "--out", "out"])


MU = ["--free", "mu"]


@pytest.mark.parametrize(
    ("arguments", "fragments"),
    [
        (["missing.csv", *MU], ["missing.csv", "does not exist"]),
        (["sheet.xlsx", *MU], [".csv", ".xlsx"]),
        (["empty.csv", *MU], ["line of names"]),
        (["short.csv", *MU], ["at least 16", "8"]),
        (["names.csv", *MU], ["no channel", "x"]),
        (["names.csv", *MU], ["which is which with `--column`"]),
        (["timeless.csv", *MU], ["`t`", "name it with `--time`, or give `--rate` in Hz"]),
        (["twice.csv", *MU], ["twice"]),
        (["nan.csv", *MU], ["line 11", "nan"]),
        (["word.csv", *MU], ["line 11", "'loud'"]),
        (["ragged.csv", *MU], ["line 11", "2 numbers expected, 3 found"]),
        (["gap.csv", *MU], ["evenly spaced"]),
        (["back.csv", *MU], ["strictly increasing"]),
        (["unit.csv", *MU], ["furlong"]),
        (["far.csv", *MU], ["coordinates are 0 to 2"]),
        (["normal.csv", *MU, "--regime", "sliding"], ["normal coordinate"]),
        (["broken.npy", *MU], ["cannot be read as NumPy"]),
        (["broken.wav", *MU], ["cannot be read as WAV"]),
        (["broken.mat", *MU], ["cannot be read as MATLAB"]),
        (["good.csv", "--free", "nu"], ["`nu`", "belt_speed"]),
        (["good.csv", "--free", ","], ["`--free`", "empty"]),
        (["good.csv", *MU, "--bound", "mu=0.1:0.3", "mu=0.1:0.4"], ["`--bound`", "`mu` twice"]),
        (["good.csv", *MU, "--column", "a0=a0", "a0=a1"], ["`--column`", "`a0` twice"]),
        (["good.csv", *MU, "--column", "X=a0", "--column", "Y=a1"], ["`--column`", "there twice", "one after the other"]),
        (["good.csv", *MU, "--overwrite", "--no-overwrite"], ["`--overwrite`", "there twice"]),
        (["good.csv", *MU, "--full-scale=2", "--full_scale", "3"], ["`--full-scale`", "there twice"]),
        (["good.csv", "--free", "mu,mu"], ["twice"]),
        (["good.csv", *MU, "--bound", "mu"], ["NAME=LOW:HIGH", "'mu'"]),
        (["good.csv", *MU, "--bound", "k1=1:2"], ["`k1`", "not among the free"]),
        (["good.csv", *MU, "--bound", "mu=0.5:0.1"], ["goes up"]),
        (["good.csv", *MU, "--bound", "mu=0.3:0.5"], ["inside its bounds", "0.227"]),
        (["good.csv", *MU, "--column", "x"], ["--column", "'x'"]),
        (["good.csv", *MU, "--column", "x=acceleration0"], ["no variable `x`"]),
        (["good.csv", *MU, "--column", "t=loudness"], ["acceleration i", "'loudness'"]),
        (["good.csv", *MU, "--unit", "t"], ["--unit", "'t'"]),
        (["good.csv", *MU, "--unit", "t=fortnight"], ["fortnight"]),
        (["good.csv", *MU, "--rate", "0"], ["`--rate`", "positive"]),
        (["good.csv", *MU, "--full-scale", "-1"], ["`--full-scale`", "positive"]),
        (["good.csv", *MU, "--offset", "0.5", "0.1"], ["`--offset`", "go up"]),
        (["good.csv", *MU, "--offset", "0", "0.1", "--regime", "limit cycle"], ["`--offset`", '"kick"']),
        (["good.csv", *MU, "--starts", "0"], ["`--starts`", "at least 1"]),
        # In the regime "kick" this is a free decay.
        (["good.csv", *MU, "--belt-speed", "0", "--regime", "sliding"], ["`belt_speed`", "zero"]),
    ],
    ids=lambda x: " ".join(x) if isinstance(x, list) else None,
)  # fmt: skip
def test_calibrate(folder, capsys, arguments, fragments):
    """A recording or an option that does not fit is refused: the fit would be of something that was not measured."""
    with untouched(folder):
        message = refused_on_the_command_line(capsys, ["calibrate", *arguments, "--out", "out"])
    for fragment in fragments:
        assert fragment in message, message


@pytest.mark.parametrize(
    ("arguments", "fragments"),
    [
        (["tradeoff", "--t1", "0"], ["`t1`", "positive"]),
        (["tradeoff", "--only", "nix"], ["`--only`", "'nix'", "event-exact"]),
        (["tradeoff", "--trajectories", "0"], ["`trajectories`", "at least 1"]),
        (["tradeoff", "--mu", "-1"], ["`mu`", "non-negative"]),
        (["tradeoff", "--belt-speed", "0"], ["`belt_speed`", "zero"]),
        (["tradeoff", "--mu", "200"], ["Painlevé", "200"]),
        (["reproduce", "--figure", "19"], ["`figure`", "'19'"]),
        (["reproduce", "--figure", "1"], ["drawing"]),
        *(
            ([command, "--mu-static", "0.3", "--mu-dynamic", "0.2"], [option, "`mu`", "mu_static"])
            for command, option in (("cea", "--x"), ("map", "--x"), ("branch", "--over"))
        ),
        (["branch", "--over", "mu=0.1:0.3", "--each", "mu=0.1:0.2:2"], ["`--each`", "another parameter", "`mu`"]),
        (["branch", "--over", "mu=0.1:0.3", "--map", "mu=0.1:0.2:2"], ["`--map`", "another parameter", "`mu`"]),
        (["branch", "--over", "mu=0.22:0.23", "--map", "p=1:2:20000"], ["400,000,000 trajectories", "Give fewer values"]),
        (["simulate", "--dt", "1e-5"], ["`--dt`", "`--method where-switched`"]),
        (["branch", "--over", "mu=0.2:0.22"], ["`bounds`", "0.227", "a scene whose mu lies between them"]),
        (["cea", "--x", "mu"], ["NAME=FROM:TO:COUNT", "'mu'"]),
        (["cea", "--x", "speed=1:2:3"], ["'speed'"]),
        # Names of options of the functions behind them.
        (["cea", "--x", "system=1:2:3"], ["'system'"]),
        (["map", "--x", "t_max=1:2:3"], ["`t_max`"]),
        (["branch", "--over", "mu=0.2:0.3", "--each", "restitution=0.5:1.5:2"], ["`restitution`"]),
        (["cea", "--x", "mu=-1:2:3"], ["`mu`", "-1"]),
        (["cea", "--x", "mu=0.1:0.2:1"], ["at least 2 values", "COUNT is 1"]),
        (["map", "--x", "mu=0.1:0.2:0"], ["at least 1 value", "COUNT is 0"]),
        (["map", "--x", "theta=0:30:4"], ["`theta`", "rad", "30 degrees are 0.5236 rad"]),
        (["map", "--belt-speed", "0"], ["`--belt-speed`", "zero", "sliding"]),
        (["simulate", "--theta", "90"], ["`--theta`", "rad", "90 degrees are 1.571 rad"]),
        (["simulate", "--decay", "0.3"], ["`--decay`", "`--mu-static` and `--mu-dynamic` are missing"]),
        (["simulate", "--mu-dynamic", "0.3"], ["`--mu-static` is missing"]),
        (["simulate", "--mu", "0.3", "--mu-static", "0.2"], ["`mu_static`", "0.2", "`mu`"]),
        (["simulate", "--mu-static", "0.3", "--mu-dynamic", "0.2", "--mu", "0.1"], ["`--mu`", "`--mu-static`", "one of them"]),
        (["cea", "--belt-speed", "0"], ["`belt_speed`", "zero"]),
        (["cea", "--k1", "-1"], ["`k1`", "non-negative"]),
        (["cea", "--theta", "nan"], ["`theta`", "finite"]),
        (["simulate", "--force", "-1"], ["`force`", "non-negative"]),
        (["simulate", "--duration", "-1"], ["`duration`", "non-negative"]),
        (["simulate", "--start", "inf"], ["`start`", "finite"]),
        (["simulate", "--m2", "0"], ["`m2`", "positive"]),
        (["simulate", "--c1", "-1"], ["`c1`", "non-negative"]),
        (["simulate", "--k1", "0", "--k2", "0"], ["singular"]),
        (["simulate", "--t1", "1e9", "--dt-save", "1e-9"], ["`dt_save`", "rows"]),
        (["map", "--force", "nan"], ["`force`", "finite"]),
        (["map", "--x", "mu=0:1:1000000", "--y", "p=0:1:1000000"], ["trajectories", "78,000,000,000,000 bytes"]),
        (["map", "--x", "mu=0:1:100000000"], ["`mu`", "800,000,000 bytes"]),
    ],
    ids=lambda x: " ".join(x) if isinstance(x, list) else None,
)  # fmt: skip
def test_other_commands(folder, capsys, arguments, fragments):
    """Values outside the model, and maps or runs too large to hold, are refused before anything is computed."""
    with untouched(folder):
        message = refused_on_the_command_line(capsys, [*arguments, "--out", "out"])
    for fragment in fragments:
        assert fragment in message, message


@pytest.mark.parametrize("command", [["cea"], ["tradeoff"], ["calibrate", "good.csv", *MU]], ids=lambda c: c[0])
def test_where_to_write_is_asked_first(folder, capsys, command):
    """An output path that cannot be written is refused before the work, not after it."""
    (folder / "taken.nc").mkdir()
    for out, fragment in (
        ("missing/out", "does not exist"),
        ("taken", "is a folder"),
        ("taken.nc/", "`taken.nc` is a folder. Name files in it"),
        ("good.csv/out", "not a folder"),
    ):
        with untouched(folder):
            assert fragment in refused_on_the_command_line(capsys, [*command, "--out", out])


@pytest.mark.parametrize(
    ("command", "there"),
    [
        (["map"], ["out.nc"]),
        (["simulate"], ["out.png"]),
        (["simulate", "--energy"], ["out_energy.png"]),
        (["cea"], ["out.nc", "out.png"]),
        (["calibrate", "good.csv", *MU], ["out.png"]),
        (["tradeoff"], ["out.nc"]),
        (["reproduce", "--figure", "3"], ["out/reproduce.md"]),
    ],
    ids=lambda x: " ".join(x),
)
def test_results_are_not_overwritten_unasked(folder, capsys, command, there):
    """A file that is already there is refused before any work, and replaced only with `--overwrite`."""
    for name in there:
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text("earlier")
    with untouched(folder):
        message = refused_on_the_command_line(capsys, [*command, "--out", "out"])
    assert f"`{there[0]}` is there already" in message and "--overwrite" in message
    if command[0] not in ("cea", "reproduce"):
        with pytest.raises(EngineReached):
            cli.main([*command, "--out", "out", "--overwrite"])
    # Neither the refusal nor the run that was stopped has written over the earlier file.
    assert (folder / there[0]).read_text() == "earlier"


def test_reproducing_into_a_file(folder, capsys):
    """A file in place of the output folder is refused before the first figure is computed."""
    with untouched(folder):
        refused_on_the_command_line(capsys, ["reproduce", "--figure", "3", "--out", "good.csv"])


def test_resuming_what_is_another_map(folder, capsys):
    """A file that is no checkpoint of this map is neither continued, which would mix two scenes, nor overwritten."""
    (folder / "text.unfinished").write_text("notes")
    message = refused_on_the_command_line(capsys, ["map", "--out", "text", "--resume"])
    assert "is not a checkpoint" in message
    checkpoint.write_checkpoint(folder / "other.unfinished", {"fivjax": "0.0"}, {"verdict": np.zeros(4, np.int8)}, {})
    with untouched(folder):
        assert "of another run" in refused_on_the_command_line(capsys, ["map", "--out", "other", "--resume"])
        assert "--resume" in refused_on_the_command_line(capsys, ["map", "--out", "other"])


def paper(**changes) -> fj.Scene:
    return fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.2), 3.0, fj.Pulse(100.0, 1.2)).replace(**changes)


def good() -> fj.Recording:
    return fj.Recording(T, {"acceleration 0": A}, "sliding")


@pytest.mark.parametrize(
    ("call", "error", "fragments"),
    [
        (lambda: fj.calibrate(None, good(), ["mu"]), TypeError, ["`scene`"]),
        (lambda: fj.calibrate(paper(), A, ["mu"]), TypeError, ["`data`"]),
        (lambda: fj.calibrate(paper(), [], ["mu"]), TypeError, ["`data`"]),
        (lambda: fj.calibrate(paper(), [good(), A], ["mu"]), TypeError, ["`data[1]`"]),
        (lambda: fj.calibrate(paper(), good(), "mu"), TypeError, ["`free`", "list of names"]),
        (lambda: fj.calibrate(paper(), good(), ["mu"], spread=2.0), ValueError, ["`spread`", "at most 0.9"]),
        (lambda: fj.calibrate(paper(), good(), ["mu"], rate=1.0), ValueError, ["too short"]),
        (lambda: fj.calibrate(paper(), good(), ["mu"], method="fast"), TypeError, ["`method`"]),
        (lambda: fj.calibrate(paper(), fj.Recording(T, {"a0": A}, mu=0.3), ["mu"]), ValueError, ["states it as known"]),
        (lambda: fj.calibrate(paper(), fj.Recording(T, {"a0": A}, heat=1.0), ["mu"]), ValueError, ["`heat`"]),
        (lambda: fj.derivatives(None, paper(), ["mu"]), TypeError, ["`functional`"]),
        (lambda: fj.derivatives(len, paper(), "mu"), TypeError, ["`wrt`"]),
        (lambda: fj.derivatives(len, paper(), []), ValueError, ["`wrt`"]),
        (lambda: fj.derivatives(len, paper(), ["mu"], mode="sideways"), ValueError, ["`mode`"]),
        (lambda: fj.tradeoff(paper(), precisions=("float16",)), ValueError, ["`precisions`", "'float16'"]),
        (lambda: fj.tradeoff(paper(), precisions="float16"), ValueError, ["`precisions`", "'float16'"]),
        (lambda: fj.tradeoff(paper(), precisions=5), TypeError, ["`precisions`"]),
        (lambda: fj.tradeoff(paper(), precisions=iter(())), ValueError, ["`precisions`", "empty"]),
        (lambda: fj.tradeoff(paper(), methods=[]), TypeError, ["`methods`"]),
        (lambda: fj.limit_cycles(paper(), np.array(0.0)), TypeError, ["`starts`"]),
        (lambda: fj.NodeContact(1, "x", "z", against=1), ValueError, ["`against`", "another node"]),
        (lambda: fj.save_figure(None, "none.png"), TypeError, ["`figure`"]),
        (lambda: fj.tradeoff(paper(), boundary="yes"), TypeError, ["`boundary`"]),
        (lambda: fj.belt_oscillator(m1=-1.0), ValueError, ["`m1`"]),
        (lambda: fj.belt_oscillator(theta="steep"), TypeError, ["`theta`"]),
        (lambda: fj.Structure(np.eye(3), np.eye(3), np.eye(2), [0, 0, -1]), ValueError, ["(2, 2)"]),
        (lambda: fj.Structure(-np.eye(3), np.eye(3), np.eye(3), [0, 0, -1]), ValueError, ["`mass`"]),
        (lambda: fj.Structure(np.eye(3), np.eye(3), np.triu(np.ones((3, 3))), [0, 0, -1]), ValueError, ["symmetric"]),
        (lambda: fj.Structure(np.eye(3), np.eye(3), np.eye(3), [0, -1]), ValueError, ["`load_direction`"]),
        (lambda: fj.Structure(np.eye(3), np.eye(3), np.eye(3), [0, 0, -1], normal=3), ValueError, ["`normal`"]),
        (lambda: fj.Structure(np.eye(3), np.eye(3), np.eye(3), [0, 0, -1], tangential=2, normal=2), ValueError, ["`tangential`"]),
        (lambda: fj.Coulomb(-0.1), ValueError, ["`mu`"]),
        (lambda: fj.Coulomb(0.3, 0.2), ValueError, ["`mu_static`", "0.2"]),
        (lambda: fj.ExponentialDecay(0.2, 0.1, -1.0), ValueError, ["`decay`"]),
        (lambda: fj.Pulse(duration=-1.0), ValueError, ["`duration`"]),
        (lambda: fj.ConstantLoad(np.nan), ValueError, ["`force`", "finite"]),
        (lambda: paper(impact_law="bouncy"), ValueError, ["`impact_law`"]),
        (lambda: fj.Scene(None, fj.Coulomb(0.2), 3.0, fj.Pulse()), TypeError, ["`structure`"]),
        (lambda: fj.Scene(fj.belt_oscillator(), 0.2, 3.0, fj.Pulse()), TypeError, ["`friction`"]),
        (lambda: fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.2), 3.0, 100.0), TypeError, ["`load`"]),
        (lambda: paper().replace(weight=1.0), ValueError, ["`weight`"]),
        (lambda: fj.cea.eigenvalues(fj.belt_oscillator()), ValueError, ["`mu`"]),
        (lambda: fj.cea.critical_friction(paper()), TypeError, ["`structure`"]),
        (lambda: fj.cea.sensitivity(None), TypeError, ["`structure`"]),
        (lambda: fj.energy_per_cycle(None), TypeError, ["`run`"]),
        (lambda: fj.plot.bistability(xr.Dataset({"verdict": 0, "amplitude": 0.0})), ValueError, ["an axis or two"]),
    ],
)  # fmt: skip
def test_functions(call, error, fragments):
    """Bad arguments of public functions are refused by name, before they fail deep inside or give a wrong answer."""
    with refused(error, *fragments):
        call()
