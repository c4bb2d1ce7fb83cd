"""The command line beside its refusals: start, version, what it says while it works and at its end."""

import gc
import os
import subprocess
import sys
import warnings
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import tyro
import xarray as xr

import fivjax as fj
from fivjax.cli import cycle_commands, main, map_command
from fivjax.cli.analysis_commands import with_options
from fivjax.cli.options import SceneOptions
from fivjax.io.datasets import labelled


@pytest.fixture(autouse=True)
def settings_stay(monkeypatch):
    """Where compiled code is kept is configured for a whole process."""
    monkeypatch.setattr("fivjax.cli.command_line.keep_compiled_code", lambda: None)


@pytest.mark.parametrize("option", ["--version", "--help"])
def test_what_a_question_loads(option):
    """`--version` and `--help` are answered without JAX, and so within a second."""
    code = f"import sys; sys.argv = ['fivjax', {option!r}]\nfrom fivjax.cli import main\ntry: main()\nexcept SystemExit: pass\n"
    code += "print('loaded', *sys.modules)"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    said, _, loaded = ran.stdout.rpartition("loaded ")
    assert (fj.__version__ if option == "--version" else "simulate") in said
    assert not {"jax", "matplotlib", "xarray", "scipy", "h5py", "diffrax"} & set(loaded.split())


def test_the_program_ends_at_once_with_its_code_and_all_it_has_said():
    command = [sys.executable, "-m", "fivjax"]
    ran = subprocess.run([*command, "cea", "--mu", "-1"], capture_output=True, text=True)
    assert ran.returncode == 2 and ran.stderr.startswith("fivjax: ") and "mu" in ran.stderr


@pytest.mark.parametrize("question", [["--version"], ["--help"], ["map", "--help"]])
def test_nothing_is_said_where_nobody_reads(question):
    reading, writing = os.pipe()
    os.close(reading)
    command = [sys.executable, "-m", "fivjax", *question]
    ran = subprocess.run(command, stdout=writing, stderr=subprocess.PIPE, text=True)
    os.close(writing)
    assert ran.returncode == 120 and ran.stderr == ""


def test_a_command_that_nobody_reads_any_more_is_no_failure_of_the_disk(monkeypatch, capsys):
    class Cycle:
        def run(self):
            raise BrokenPipeError

    monkeypatch.setattr(tyro.extras, "subcommand_cli_from_dict", lambda *_, **__: Cycle())
    with pytest.raises(BrokenPipeError):
        main(["cycle"])
    assert capsys.readouterr().err == ""


def test_the_module_is_the_program():
    ran = subprocess.run([sys.executable, "-m", "fivjax", "--version"], capture_output=True, text=True, check=True)
    assert ran.stdout == f"fivjax {fj.__version__}\n"


def made_up_map(verdicts):
    """A stand-in for `bistability_map` that finds these verdicts."""

    def make(scene, *, method, t_max, memory, resume, refine, executor=None, **axes):
        dims = tuple(axes)
        fields = {"verdict": (dims, np.array(verdicts, np.int8)), "amplitude": (dims, np.ones(np.shape(verdicts)))}
        return labelled(xr.Dataset(fields, axes), scene)

    return make


def test_a_map_counts_trajectories(monkeypatch, tmp_path, capsys):
    """One trajectory is not called several, and none is called a lane."""
    monkeypatch.setattr(fj, "bistability_map", made_up_map([[0, 0], [0, 1]]))
    axes = ["--x", "mu=0.1:0.2:2", "--y", "p=1:2:2"]
    assert main(["map", *axes, "--out", str(tmp_path / "map")]) == 0
    said = capsys.readouterr().out
    assert "3 trajectories: sliding" in said and "1 trajectory: limit cycle" in said and "lane" not in said


def test_a_map_without_any_verdict_is_a_failure(monkeypatch, tmp_path, capsys):
    """A script must not go on with a map in which no trajectory could be started: the exit code is not zero."""
    monkeypatch.setattr(fj, "bistability_map", made_up_map([[-3, -3], [-3, -3]]))
    assert main(["map", "--x", "mu=0.1:0.2:2", "--y", "p=1:2:2", "--out", str(tmp_path / "map")]) == 1
    assert "No trajectory of the map could be followed: no equilibrium." in capsys.readouterr().err


def test_a_cycle_without_a_saddle_is_written(monkeypatch, tmp_path, capsys):
    """What was computed stays, although the other half of what was asked for does not exist."""
    written = []
    monkeypatch.setattr(fj, "limit_cycle", lambda scene: "the cycle")
    monkeypatch.setattr(fj, "saddle_cycle", Mock(side_effect=fj.NoLimitCycle("There is no saddle.")))
    monkeypatch.setattr(fj.plot, "cycle", lambda cycle, others: others)
    for write in ("write_data", "write_picture"):
        monkeypatch.setattr(cycle_commands, write, lambda what, path: written.append((what, path.name)))
    assert main(["cycle", "--saddle", "--out", str(tmp_path / "own")]) == 1
    assert written == [("the cycle", "own.nc"), ([], "own.png")]
    said = capsys.readouterr()
    assert "the cycle" in said.out and "There is no saddle." in said.err


def test_friction_options():
    """What is said of friction is used; where nothing is said it is the paper's."""
    assert float(SceneOptions().scene().friction.mu) == 0.227
    static = SceneOptions(mu=0.2, mu_static=0.3).scene().friction
    assert isinstance(static, fj.Coulomb) and (float(static.mu), float(static.mu_static)) == (0.2, 0.3)
    falling = SceneOptions(mu_static=0.3, mu_dynamic=0.2).scene().friction
    assert isinstance(falling, fj.ExponentialDecay) and float(falling.decay) == 0.5
    assert float(SceneOptions(mu_static=0.3, mu_dynamic=0.2, decay=0.7).scene().friction.decay) == 0.7


@pytest.mark.parametrize(
    ("sentence", "expected"),
    [
        ("Say which is which with `columns`.", "Say which is which with `--column`."),
        ("It has no column `t` or `time`; name it with `time`, or give `rate` in Hz.",
         "It has no column `t` or `time`; name it with `--time`, or give `--rate` in Hz."),
        ("Argument `rate` must be positive, but is 0.", "Option `--rate` must be positive, but is 0."),
        ("Recording 0 is too short. Raise `rate`, or record for longer.", "Recording 0 is too short. Record for longer."),
        ("`rate` is 50 Hz. Leave out `rate`.", "`rate` is 50 Hz. Leave out `--rate`."),
        ("Argument `starts` must be 1. Widen `bounds`.", "Option `--starts` must be 1. Widen `--bound`."),
    ],
)  # fmt: skip
def test_a_remedy_names_the_option(sentence, expected):
    """`columns` is Python's; a user of the command line looks for `--column`."""
    assert with_options(sentence) == expected


def test_where_a_map_is_kept_and_who_computes(monkeypatch, tmp_path, capsys):
    """`--resume` alone means the file beside the map; with a folder, that folder, which stays."""
    asked = {}

    def make(scene, *, resume, executor, **options):
        asked.update(resume=resume, executor=executor)
        Path(resume).mkdir() if Path(resume).suffix == ".zarr" else Path(resume).touch()
        return made_up_map([[0, 1], [0, 1]])(
            scene, method=None, t_max=20.0, memory=1.0, resume=None, refine=0, **{n: options[n] for n in ("mu", "p")}
        )

    monkeypatch.setattr(fj, "bistability_map", make)
    command = ["map", "--x", "mu=0.1:0.2:2", "--y", "p=1:2:2", "--out", str(tmp_path / "map")]
    assert main([*command, "--resume"]) == 0
    assert asked["resume"] == tmp_path / "map.unfinished" and not asked["resume"].exists()
    folder = tmp_path / "kept.zarr"
    assert main([*command, "--overwrite", "--resume", str(folder), "--workers", "2"]) == 0
    assert asked["resume"] == folder and folder.exists() and callable(asked["executor"])
    capsys.readouterr()
    for options, said in (
        (["--resume", str(tmp_path / "kept")], "ends in .zarr"),
        (["--workers", "-1"], "must not be negative"),
        (["--workers", "1", "--dask", "tcp://127.0.0.1:1"], "give one of them"),
    ):
        assert main([*command, "--overwrite", *options]) == 2
        assert said in capsys.readouterr().err


def test_an_interrupt_after_the_data_says_that_they_are_there(monkeypatch, tmp_path, capsys):
    def drawn(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(fj, "save_figure", drawn)
    assert main(["simulate", "--t1", "0.01", "--out", str(tmp_path / "run")]) == 130
    said = capsys.readouterr()
    assert f"wrote {tmp_path / 'run.nc'}" in said.out and "nothing more was written" in said.err
    assert (tmp_path / "run.nc").exists()


def test_cea_of_falling_friction_says_whether_this_scene_slides(tmp_path, capsys):
    """At 1.1 m/s its friction is below the critical one of constant friction, and yet sliding is unstable."""
    falling, out = ["--mu-static", "0.3", "--mu-dynamic", "0.12"], ["--out", str(tmp_path / "out")]
    assert main(["cea", *falling, "--belt-speed", "1.1", "--x", "belt_speed=1:1.1:2", *out]) == 0
    growth = fj.cea.growth_rate(
        fj.Scene(fj.belt_oscillator(), fj.ExponentialDecay(0.3, 0.12), 1.1, fj.ConstantLoad(100.0))
    )
    said = capsys.readouterr().out
    assert (
        f"growth rate of this scene {growth:.6g} 1/s, so steady sliding is unstable; if friction were constant:" in said
    )
    assert said.index("if friction were constant") < said.index("critical friction")


def test_what_draws_is_imported_without_collections_of_garbage(monkeypatch):
    """One inside the loader of a library could hand Python to a thread that waits for the loader."""
    seen = []
    monkeypatch.setattr(map_command.importlib, "import_module", lambda name: seen.append((name, gc.isenabled())))
    map_command.import_what_draws()
    assert seen == [("fivjax.plot", False)] and gc.isenabled()


def test_an_interrupted_branch_is_written(monkeypatch, tmp_path, capsys):
    def followed(*_, **__):
        warnings.warn("Interrupted: so it is.", stacklevel=2)
        return xr.Dataset({"amplitude": ("point", np.ones(2))}, attrs={"interrupted": 1})

    monkeypatch.setattr(fj, "continue_cycle", followed)
    assert main(["branch", "--over", "mu=0.2:0.25", "--mu", "0.227", "--out", str(tmp_path / "b")]) == 130
    assert [path.name for path in tmp_path.iterdir()] == ["b.nc"]
    assert capsys.readouterr().err.endswith(f"Interrupted; `{tmp_path / 'b.nc'}` has the 2 cycles known by then.\n")


def test_a_branch_that_cannot_begin_costs_none_that_is_done(monkeypatch, tmp_path, capsys):
    """Values that look alike in six digits are told apart."""

    def followed(scene, *_, **__):
        if float(scene.belt_speed) > 1:
            raise fj.NoLimitCycle("No limit cycle here.")
        return xr.Dataset({"amplitude": ("point", np.ones(2))})

    monkeypatch.setattr(fj, "continue_cycle", followed)
    command = ["branch", "--over", "mu=0.2:0.25", "--mu", "0.227", "--each", "belt_speed=1:1.0000001:2"]
    assert main([*command, "--out", str(tmp_path / "b")]) == 1
    assert "belt_speed = 1.0000001: No limit cycle here." in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["b-1.nc"]
