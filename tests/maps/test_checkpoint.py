"""Long runs: interrupted at any moment, resumed, and bit for bit what they would have been."""

import contextlib
import errno
import json
import os
import subprocess
import sys

import jax
import numpy as np
import pytest
import xarray as xr

import fivjax as fj
from fivjax import cli
from fivjax.attractors.catalogue import Attractors
from fivjax.maps import checkpoint, job_files, jobs, plan
from fivjax.maps.job_files import JobState
from fivjax.maps.results import not_run, record
from fivjax.maps.trajectory_kernels import TrajectoryKernels
from tests.helpers import killed_map

AXES = {"mu": [0.1, 0.2, 0.227], "p": [1.02, 1.1, 1.19, 1.5, 3.0]}


@pytest.fixture
def at_once(monkeypatch):
    # After each job, however long the write before it took.
    monkeypatch.setattr(checkpoint, "KEEP_EVERY", 0.0)
    monkeypatch.setattr(checkpoint, "SHARE_OF_TIME", 0.0)
    monkeypatch.setattr(plan, "IN_A_JOB", 5)


@pytest.fixture(scope="module")
def whole():
    scene = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.227), 3.0, fj.Pulse(100.0, 1.2))
    return fj.bistability_map(scene, progress=False, **AXES)


def same(a: xr.Dataset, b: xr.Dataset) -> bool:
    """Bit for bit: also the NaN of one are the NaN of the other."""
    return set(a.data_vars) == set(b.data_vars) and all(
        a[name].dtype == b[name].dtype and a[name].values.tobytes() == b[name].values.tobytes() for name in a.data_vars
    )


@pytest.mark.parametrize("calls", [1, 3, 6])
def test_a_map_interrupted_between_any_two_blocks_is_resumed_bit_for_bit(
    paper_scene, whole, tmp_path, monkeypatch, at_once, calls
):
    """A job's results do not depend on what runs beside it, and it is kept as a whole or not at all."""
    real, made = TrajectoryKernels.follow, []

    def interrupted(*args):
        made.append(1)
        if len(made) == calls:
            raise KeyboardInterrupt
        return real(*args)

    path = tmp_path / "map.part"
    monkeypatch.setattr(TrajectoryKernels, "follow", interrupted)
    with pytest.warns(UserWarning, match="Interrupted"):
        first = fj.bistability_map(paper_scene, progress=False, resume=path, **AXES)
    open_ = first["verdict"] == fj.Verdict.NOT_RUN
    assert np.any(open_)
    # What was finished when the interrupt came is on the disk, and only that.
    if path.exists():
        with xr.open_dataset(path, engine="h5netcdf") as kept:
            finished = np.flatnonzero(~open_.values.ravel())
            np.testing.assert_array_equal(kept["place"], finished)
            np.testing.assert_array_equal(kept["verdict"], first["verdict"].values.ravel()[finished])
    resumed = fj.bistability_map(paper_scene, progress=False, resume=path, **AXES)
    assert same(resumed, whole)
    # A finished map runs nothing again.
    monkeypatch.setattr(jobs, "follow_all", None)
    assert same(fj.bistability_map(paper_scene, progress=False, resume=path, **AXES), whole)
    assert [entry.name for entry in tmp_path.iterdir()] == ["map.part"]


@pytest.mark.parametrize("calls", [2, 6])
def test_an_interrupted_job_goes_on_from_where_it_was(paper_scene, whole, tmp_path, monkeypatch, calls):
    """A map of one job, stopped before and after its search for attractors: rounds that are done are not done again."""
    real, made = TrajectoryKernels.follow, []

    def counting(*args):
        made.append(1)
        if len(made) == stop:
            raise KeyboardInterrupt
        return real(*args)

    monkeypatch.setattr(TrajectoryKernels, "follow", counting)
    monkeypatch.setattr(job_files, "KEEP_EVERY", 0.0)
    monkeypatch.setattr(job_files, "SHARE_OF_TIME", 0.0)
    path, stop = tmp_path / "map.part", 0
    fj.bistability_map(paper_scene, progress=False, resume=tmp_path / "whole.part", **AXES)
    total, stop = len(made), calls
    made.clear()
    with pytest.warns(UserWarning, match="Interrupted"):
        fj.bistability_map(paper_scene, progress=False, resume=path, **AXES)
    stop = 0
    made.clear()
    assert same(fj.bistability_map(paper_scene, progress=False, resume=path, **AXES), whole)
    # The round that was interrupted is the only one that is repeated; in a search, its last part.
    assert total > calls and len(made) <= total - calls + 3
    assert {entry.name for entry in tmp_path.iterdir()} == {"map.part", "whole.part"}


def test_what_is_left_of_another_maps_first_job_is_refused_and_stays(paper_scene, whole, tmp_path, monkeypatch):
    """Interrupted before its first job was done, a map has no checkpoint yet: only the file of the job says whose it is."""
    real, made = TrajectoryKernels.follow, []

    def stopping(*args):
        made.append(1)
        if len(made) == 3:
            raise KeyboardInterrupt
        return real(*args)

    monkeypatch.setattr(TrajectoryKernels, "follow", stopping)
    monkeypatch.setattr(job_files, "KEEP_EVERY", 0.0)
    monkeypatch.setattr(job_files, "SHARE_OF_TIME", 0.0)
    path = tmp_path / "map.part"
    with pytest.warns(UserWarning, match="Interrupted"):
        fj.bistability_map(paper_scene, progress=False, resume=path, **AXES)
    assert [entry.name for entry in tmp_path.iterdir()] == ["map.part.jobs"]
    kept = {file.name: file.read_bytes() for file in (tmp_path / "map.part.jobs").iterdir()}
    with pytest.raises(ValueError, match=r"map.part.jobs` is of another run: its `mu` is"):
        fj.bistability_map(paper_scene, progress=False, resume=path, **(AXES | {"mu": [0.1, 0.2]}))
    assert kept == {file.name: file.read_bytes() for file in (tmp_path / "map.part.jobs").iterdir()}
    assert same(fj.bistability_map(paper_scene, progress=False, resume=path, **AXES), whole)


def test_the_state_of_a_job_comes_back_from_its_file_bit_for_bit(tmp_path):
    """And is not that of another job, nor of another run."""
    rng, folder = np.random.default_rng(0), tmp_path / "map.part.jobs"
    verdicts = not_run(5, energy=True)
    for values in verdicts.energy.values():
        values[:] = rng.normal(size=5)
    state = JobState(
        done=64,
        own_from=128,
        verdicts=verdicts,
        pending=np.array([1, 4]),
        numbers=rng.normal(size=(2, 7)),
        settled_by=rng.random(3),
        searched={b"group": Attractors.none()},
        known={2: Attractors.none()},
        at_last={},
    )
    file = job_files.JobFile(*job_files.file_of(folder, {"of": 1}, np.arange(5)))
    file.note(state)
    file.flush()
    again = job_files.JobFile(*job_files.file_of(folder, {"of": 1}, np.arange(5))).last()
    assert again is not None
    for mine, theirs in zip(jax.tree.leaves(again), jax.tree.leaves(state), strict=True):
        np.testing.assert_array_equal(mine, theirs)
    for run, places in (({"of": 2}, np.arange(5)), ({"of": 1}, np.arange(4))):
        assert job_files.JobFile(*job_files.file_of(folder, run, places)).last() is None


def test_an_interrupt_inside_a_record_makes_no_trajectory_look_finished():
    """The verdict is written last: an interrupt before it leaves the trajectory as not run."""

    class Unreadable:
        energy = None

        @property
        def t(self):
            raise KeyboardInterrupt

    verdicts = not_run(1, energy=False)
    with pytest.raises(KeyboardInterrupt):
        record(verdicts, np.array([0]), Unreadable(), np.array([1]), {"amplitude": np.array([1.0])})
    assert verdicts.verdict[0] == fj.Verdict.NOT_RUN


@pytest.mark.parametrize(
    ("change", "fragment"),
    [
        (dict(mu=[0.1, 0.2, 0.226]), "`mu`"),
        (dict(t_max=19.0), "`t_max` is null and not 19.0"),
        (dict(method=fj.WhereSwitched()), "`method`"),
    ],
)
def test_a_checkpoint_of_another_run_is_refused(paper_scene, whole, tmp_path, change, fragment):
    """A checkpoint with another axis, limit, method or scene would mix two runs in one map."""
    path = tmp_path / "map.part"
    fj.bistability_map(paper_scene, progress=False, resume=path, **AXES)
    before = path.read_bytes()
    with pytest.raises(ValueError, match=fragment):
        fj.bistability_map(paper_scene, progress=False, resume=path, **{**AXES, **change})
    with pytest.raises(ValueError, match=r"`force` is 100\.0 and not 90\.0"):
        fj.bistability_map(paper_scene.replace(force=90.0), progress=False, resume=path, **AXES)
    assert path.read_bytes() == before


def inodes(folder) -> set[int]:
    """Those of all files in a folder, in which others may make and remove some."""
    found = set()
    for inner, _, _ in os.walk(folder):
        with contextlib.suppress(FileNotFoundError):
            found |= {entry.inode() for entry in os.scandir(inner)}
    return found


def test_a_full_disk_costs_nothing_that_was_finished(paper_scene, whole, tmp_path, monkeypatch, at_once):
    """A failing write neither stops the run nor breaks the older checkpoint."""
    path, real, calls = tmp_path / "map.part", os.fsync, []

    def full(handle):
        # What is compiled meanwhile is written, too, and does not count.
        if os.fstat(handle).st_ino in inodes(tmp_path):
            calls.append(1)
            if len(calls) % 2 == 0:
                raise OSError(errno.ENOSPC, "No space left on device")
        real(handle)

    monkeypatch.setattr(os, "fsync", full)
    with pytest.warns(UserWarning, match="No space left on device"):
        m = fj.bistability_map(paper_scene, progress=False, resume=path, **AXES)
    assert same(m, whole)
    assert [entry.name for entry in tmp_path.iterdir()] == ["map.part"]
    with xr.open_dataset(path, engine="h5netcdf") as kept:
        assert kept.attrs["kind"] == checkpoint.KIND


def test_a_disk_that_is_really_full_brings_nothing_down(tmp_path):
    """The process ends in a sentence; HDF5 on a full disk would end it in a segmentation fault."""
    program = (
        "import resource, sys, numpy as np, xarray as xr, fivjax as fj\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))\n"
        "try: fj.save(xr.Dataset({'a': ('x', np.random.default_rng(0).random(100_000))}), sys.argv[1])\n"
        "except OSError as error: print(error.strerror)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path / "a.nc")], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout.strip(), list(tmp_path.iterdir())) == (0, "File too large", [])


def test_a_run_is_locked_although_another_one_ends_as_it_begins(tmp_path, monkeypatch):
    """The other one removes the folder of the lock. Without a lock a third run would write the same file."""
    path, real = tmp_path / "map.part", checkpoint.RunLock
    running = [checkpoint.Checkpoint(path, {"a": 1}, 10, False)]

    def after_the_other(*args):
        if running:
            running.pop().close()
        return real(*args)

    monkeypatch.setattr(checkpoint, "RunLock", after_the_other)
    second = checkpoint.Checkpoint(path, {"a": 1}, 10, False)
    with pytest.raises(ValueError, match="is being written by another process"):
        checkpoint.Checkpoint(path, {"a": 1}, 10, False)
    second.close()
    assert list(tmp_path.iterdir()) == []


def test_what_is_no_checkpoint_is_refused_and_left_alone(paper_scene, tmp_path):
    """A mistyped path does not cost a file."""
    text, result = tmp_path / "notes.txt", tmp_path / "result.nc"
    text.write_text("notes")
    fj.save(xr.Dataset({"a": ("x", np.arange(3.0))}), result)
    for path in (text, result):
        before = path.read_bytes()
        with pytest.raises(ValueError, match="is not a checkpoint of fivjax"):
            fj.bistability_map(paper_scene, p=[1.1], resume=path)
        assert path.read_bytes() == before


def test_a_file_where_jobs_are_kept_is_refused_and_left_alone(paper_scene, tmp_path):
    (tmp_path / "map.part.jobs").write_text("notes")
    with pytest.raises(ValueError, match=r"map\.part\.jobs` is where the jobs of checkpoint"):
        fj.bistability_map(paper_scene, progress=False, resume=tmp_path / "map.part", **AXES)
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("map.part.jobs", "notes")]


def test_the_command_does_not_overwrite_an_interrupted_map(tmp_path, capsys, monkeypatch):
    """A map begun anew without a word would throw away what the interrupted one had finished."""
    monkeypatch.setattr("fivjax.cli.command_line.keep_compiled_code", lambda: None)
    (tmp_path / "map.unfinished").write_bytes(b"hours of work")
    assert cli.main(["map", "--out", str(tmp_path / "map")]) == 2
    assert "--resume" in capsys.readouterr().err
    assert (tmp_path / "map.unfinished").read_bytes() == b"hours of work"


@pytest.mark.slow
def test_a_killed_command_is_resumed_bit_for_bit(tmp_path):
    """kill -9 at an instant of its own choosing, then SIGTERM, then to the end: the same map as without."""
    cache = tmp_path / "cache"
    folders = {name: tmp_path / name for name in ("whole", "killed")}
    for folder in folders.values():
        folder.mkdir()
    assert killed_map.run(folders["whole"], cache=cache).returncode == 0
    assert {path.name for path in folders["whole"].iterdir()} == {"map.nc", "map.png"}
    assert killed_map.run(folders["killed"], "SIGKILL", 0.05, cache).returncode == -9
    assert not (folders["killed"] / "map.nc").exists()
    ended = killed_map.run(folders["killed"], "SIGTERM", 0.05, cache)
    assert ended.returncode == 143, ended.stderr
    assert "--resume" in ended.stderr and "Traceback" not in ended.stderr
    assert not (folders["killed"] / "map.nc").exists()
    assert killed_map.run(folders["killed"], cache=cache).returncode == 0
    maps = [xr.open_dataset(folder / "map.nc", engine="h5netcdf").load() for folder in folders.values()]
    assert same(*maps)
    assert json.loads(maps[0].attrs["counts"])["not_run"] == 0
    assert not (folders["killed"] / "map.unfinished").exists()
