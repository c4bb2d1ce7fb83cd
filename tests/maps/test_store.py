"""Maps kept in a folder of chunks: whole at any instant, resumed job by job, and of one run only."""

import errno
import json
import os

import numpy as np
import pytest
import xarray as xr

import fivjax as fj
from fivjax.attractors.approach import Approach
from fivjax.attractors.catalogue import Attractors
from fivjax.attractors.cycles import StableCycle
from fivjax.attractors.neighbourhood import Neighbourhood
from fivjax.attractors.tori import Torus
from fivjax.attractors.tube import Tube
from fivjax.maps import engine, plan, store
from fivjax.maps.job_files import attractors_from_bytes, attractors_to_bytes
from tests.helpers import stand_in_jobs

AXES = {"mu": np.linspace(0.1, 0.2, 6), "p": np.linspace(1.0, 3.0, 7)}

pytest.importorskip("zarr")


@pytest.fixture
def jobs_run(monkeypatch):
    """Jobs of two values of mu each, stood in for; the values that were run, and after how many jobs to be interrupted."""
    run, after = [], []

    def stand_in(job, *_):
        if after and len(run) == after[0]:
            raise KeyboardInterrupt
        run.append(job.values["mu"])
        return stand_in_jobs.run(job)

    monkeypatch.setattr(plan, "IN_A_JOB", 14)
    monkeypatch.setattr(engine, "run_job", stand_in)
    monkeypatch.setattr(engine, "cores", lambda: 1)
    return run, after


def expected():
    mu, p = np.meshgrid(AXES["mu"], AXES["p"], indexing="ij")
    return (p > 2).astype(np.int8), np.sin(p) * mu


def files(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file() and path.name != ".lock"}


def test_an_interrupted_map_is_read_while_unfinished_and_its_missing_jobs_are_run(paper_scene, tmp_path, jobs_run):
    """What is finished is not computed again, and nothing that is not finished is taken for a result."""
    (run, after), path = jobs_run, tmp_path / "map.zarr"
    after.append(2)
    with pytest.warns(UserWarning, match="Interrupted"):
        first = fj.bistability_map(paper_scene, resume=path, progress=False, **AXES)
    kept = xr.open_zarr(path)
    np.testing.assert_array_equal(kept["verdict"], first["verdict"])
    np.testing.assert_array_equal(kept["mu"], AXES["mu"])
    assert json.loads(first.attrs["counts"])["not_run"] == 14
    after.clear()
    whole = fj.bistability_map(paper_scene, resume=path, progress=False, **AXES)
    assert len(run) == 3
    verdict, amplitude = expected()
    np.testing.assert_array_equal(whole["verdict"], verdict)
    np.testing.assert_array_equal(xr.open_zarr(path)["amplitude"], amplitude)
    # Nothing is left to do, nor done.
    before = files(path)
    fj.bistability_map(paper_scene, resume=path, progress=False, **AXES)
    assert len(run) == 3 and files(path) == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["map.zarr"]


def test_a_broken_chunk_is_run_again(paper_scene, tmp_path, jobs_run):
    """After a power cut a file may hold anything."""
    (run, _), path = jobs_run, tmp_path / "map.zarr"
    fj.bistability_map(paper_scene, resume=path, progress=False, **AXES)
    (path / "amplitude" / "c" / "1" / "0").write_bytes(b"half a chu")
    (path / "verdict" / "c" / "2" / "0").unlink()
    with pytest.warns(UserWarning, match="file `amplitude/c/1/0` is not what was written"):
        m = fj.bistability_map(paper_scene, resume=path, progress=False, **AXES)
    assert [mu.min() for mu in run[3:]] == [AXES["mu"][2], AXES["mu"][4]]
    np.testing.assert_array_equal(m["amplitude"], expected()[1])
    np.testing.assert_array_equal(xr.open_zarr(path)["amplitude"], expected()[1])


def test_the_store_of_another_run_is_refused_and_left_alone(paper_scene, tmp_path, jobs_run):
    path = tmp_path / "map.zarr"
    fj.bistability_map(paper_scene, resume=path, progress=False, **AXES)
    before = files(path)
    with pytest.raises(ValueError, match=r"of another run: its `force` is 100\.0 and not 90\.0"):
        fj.bistability_map(paper_scene.replace(force=90.0), resume=path, progress=False, **AXES)
    with pytest.raises(ValueError, match="`mu`"):
        fj.bistability_map(paper_scene, resume=path, progress=False, mu=AXES["mu"][1:], p=AXES["p"])
    assert files(path) == before


def test_what_is_no_store_is_refused_and_left_alone(paper_scene, tmp_path, jobs_run):
    """A mistyped path does not cost a folder."""
    theirs = tmp_path / "theirs.zarr"
    xr.Dataset({"a": ("x", np.arange(3.0))}).to_zarr(theirs, consolidated=False)
    (tmp_path / "file.zarr").write_text("notes")
    before = files(tmp_path)
    for path in (theirs, tmp_path / "file.zarr"):
        with pytest.raises(ValueError, match="is not a store of fivjax"):
            fj.bistability_map(paper_scene, resume=path, progress=False, **AXES)
    with pytest.raises(ValueError, match="does not exist"):
        fj.bistability_map(paper_scene, resume=tmp_path / "none" / "map.zarr", progress=False, **AXES)
    assert files(tmp_path) == before


@pytest.mark.parametrize("name", ["map.zarr", "map.part"])
def test_a_map_stays_where_it_was_begun_though_the_working_directory_changes(
    paper_scene, tmp_path, jobs_run, monkeypatch, name
):
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path)

    def moving(job, *_):
        monkeypatch.chdir(tmp_path / "elsewhere")
        return stand_in_jobs.run(job)

    monkeypatch.setattr(engine, "run_job", moving)
    fj.bistability_map(paper_scene, resume=name, progress=False, **AXES)
    assert {entry.name for entry in tmp_path.iterdir()} == {"elsewhere", name}
    assert not list((tmp_path / "elsewhere").iterdir())


@pytest.mark.parametrize("name", ["map.zarr", "map.part"])
def test_a_second_writer_is_refused(paper_scene, tmp_path, jobs_run, monkeypatch, name):
    """Two runs of one map would write the same chunks, or each a file without what the other has done."""
    path = tmp_path / name

    def second(job, *_):
        with pytest.raises(ValueError, match=rf"{name}` is being written by another process, number {os.getpid()} on"):
            fj.bistability_map(paper_scene, resume=path, progress=False, **AXES)
        return stand_in_jobs.run(job)

    monkeypatch.setattr(engine, "run_job", second)
    fj.bistability_map(paper_scene, resume=path, progress=False, **AXES)
    assert [entry.name for entry in tmp_path.iterdir()] == [name]


def test_a_full_disk_is_said_of_the_store_and_what_it_holds_stays(paper_scene, tmp_path, jobs_run, monkeypatch):
    """The system's error names neither the store nor what to do."""
    (run, _), path, full = jobs_run, tmp_path / "map.zarr", []
    sync = store._sync

    def sync_until_full(chunk):
        if len(run) == 3:
            full.append(chunk)
            raise OSError(errno.ENOSPC, "No space left on device")
        sync(chunk)

    monkeypatch.setattr(store, "_sync", sync_until_full)
    with pytest.raises(OSError, match=rf"Store `{path}` cannot be written: No space left on device. .* Make room"):
        fj.bistability_map(paper_scene, resume=path, progress=False, **AXES)
    monkeypatch.setattr(store, "_sync", sync)
    run.clear()
    again = fj.bistability_map(paper_scene, resume=path, progress=False, **AXES)
    np.testing.assert_array_equal(again["verdict"], expected()[0])
    assert full and len(run) == 2  # of three jobs


def test_a_refined_map_is_kept_level_by_level(paper_scene, tmp_path, jobs_run):
    """Levels write into the same chunks; what an earlier one has written stays."""
    (run, after), path = jobs_run, tmp_path / "map.zarr"
    whole = fj.bistability_map(paper_scene, refine=2, progress=False, **AXES)
    count = len(run)
    run.clear()
    after.append(count // 2)
    with pytest.warns(UserWarning, match="Interrupted"):
        fj.bistability_map(paper_scene, refine=2, resume=path, progress=False, **AXES)
    after.clear()
    m = fj.bistability_map(paper_scene, refine=2, resume=path, progress=False, **AXES)
    assert len(run) == count
    for name in m.data_vars:
        np.testing.assert_array_equal(m[name], whole[name])


def test_attractors_come_back_from_a_file_bit_for_bit():
    rng = np.random.default_rng(0)
    near = Neighbourhood(rng.normal(size=6), 1, -1.0, rng.normal(size=(6, 6)), 0.1, 0.7, 256)
    cycle = StableCycle(rng.normal(size=(2, 6)), 0.1, 0.5, 3.0, near)
    other = cycle._replace(period=0.2)
    found = {
        b"one": Attractors([cycle, other], [], [Approach(other, Tube(rng.normal(size=(5, 6)), 0.04))]),
        b"two": Attractors([], [Torus(Tube(rng.normal(size=(9, 6)), radius), 2.0, 0.3) for radius in (0.04, 0.01)], []),
    }
    again = attractors_from_bytes(attractors_to_bytes(found))
    assert list(again) == list(found)
    assert not again[b"one"].tori and not again[b"two"].cycles
    for mine, theirs in zip(again[b"two"].tori, found[b"two"].tori, strict=True):
        np.testing.assert_array_equal(mine.tube.states, theirs.tube.states)
        assert (mine.tube.radius, *mine[1:]) == (theirs.tube.radius, *theirs[1:])
    (approach,), (first, second) = again[b"one"].approaches, again[b"one"].cycles
    assert approach.cycle is second
    np.testing.assert_array_equal(approach.tube.states, found[b"one"].approaches[0].tube.states)
    for mine, whole in ((first, cycle), (second, other)):
        for part, theirs in zip((*mine[:-1], *mine[-1]), (*whole[:-1], *near), strict=True):
            np.testing.assert_array_equal(part, theirs)
            assert type(part) is type(theirs)
