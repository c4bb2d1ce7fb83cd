"""Single bits flipped in what a map has kept: never a wrong result, never an error without a sentence."""

import errno
import random
import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest

import fivjax as fj
from fivjax.maps import engine, job_files, plan, store
from fivjax.maps.checkpoint import BLOCK, Checkpoint
from fivjax.maps.results import not_run
from fivjax.maps.run_lock import LOCK, RunLock
from tests.helpers import stand_in_jobs

AXES = {"mu": np.linspace(0.1, 0.2, 3), "p": np.linspace(1.0, 3.0, 4)}


@pytest.fixture
def jobs_run(monkeypatch):
    """Jobs of one value of mu each, stood in for; the values that were run."""
    run = []

    def stand_in(job, *_):
        run.append(job.values["mu"][0])
        return stand_in_jobs.run(job)

    monkeypatch.setattr(plan, "IN_A_JOB", 4)
    monkeypatch.setattr(engine, "run_job", stand_in)
    monkeypatch.setattr(engine, "cores", lambda: 1)
    return run


def flipped(path: Path, bit: int) -> None:
    data = bytearray(path.read_bytes())
    data[bit // 8] ^= 1 << bit % 8
    path.write_bytes(data)


def the_map(scene, path=None):
    return fj.bistability_map(scene, resume=path, progress=False, refine=1, **AXES)


@pytest.mark.parametrize("kind", ["part", "zarr"])
def test_a_flipped_bit_is_never_a_result(paper_scene, tmp_path, jobs_run, kind):
    """Anywhere: in results, attractors, metadata, and checksums themselves."""
    if kind == "zarr":
        pytest.importorskip("zarr")
    right, path = the_map(paper_scene), tmp_path / f"map.{kind}"
    the_map(paper_scene, path)
    files = [file for file in ([path] if kind == "part" else sorted(path.rglob("*"))) if file.is_file()]
    files = [file for file in files if file.name != LOCK]
    before = {file: file.read_bytes() for file in files}
    rng, refusals = random.Random(0), 0
    for _ in range(15):
        file = rng.choice(files)
        flipped(file, rng.randrange(8 * len(before[file])))
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=r"(Store|Checkpoint) `.*` (is|was) damaged")
            try:
                m = the_map(paper_scene, path)
            except ValueError as error:
                if "damaged" not in str(error):
                    raise
                refusals += 1
            else:
                assert all(m[name].values.tobytes() == right[name].values.tobytes() for name in right.data_vars)
        for file, content in before.items():
            file.write_bytes(content)
    assert refusals < 8


def test_a_damaged_part_of_a_checkpoint_is_named_and_alone_is_computed_anew(paper_scene, tmp_path, jobs_run):
    path, run = tmp_path / "map.part", {"of": "a test"}
    verdicts = not_run(3 * BLOCK, energy=False)
    verdicts.verdict[:], verdicts.amplitude[:] = 1, np.arange(3 * BLOCK)
    first = Checkpoint(path, run, 3 * BLOCK, energy=False)
    first.keep(np.arange(3 * BLOCK), verdicts, {})
    first.flush()
    first.close()
    at = path.read_bytes().find(np.arange(BLOCK, BLOCK + 4.0).tobytes())
    flipped(path, 8 * at)
    with pytest.warns(UserWarning, match=rf"`amplitude` in its rows {BLOCK} to {2 * BLOCK - 1} is not what was"):
        again = Checkpoint(path, run, 3 * BLOCK, energy=False)
    assert np.flatnonzero(again.recall(None).pending()).tolist() == list(range(BLOCK, 2 * BLOCK))
    again.close()


def test_attractors_that_are_lost_are_found_again(paper_scene, tmp_path, jobs_run):
    """Later jobs would find others, with other last bits, without those that the first jobs found."""
    pytest.importorskip("zarr")
    path = tmp_path / "map.zarr"
    the_map(paper_scene, path)
    jobs_run.clear()
    flipped(path / "attractors" / "0.npz", 100)
    the_map(paper_scene, path)
    assert jobs_run == [AXES["mu"][0]]


def test_damaged_metadata_are_made_again_or_refused(paper_scene, tmp_path, jobs_run):
    pytest.importorskip("zarr")
    path = tmp_path / "map.zarr"
    the_map(paper_scene, path)
    before = (path / "amplitude" / "zarr.json").read_bytes()
    flipped(path / "amplitude" / "zarr.json", 500)
    with pytest.warns(UserWarning, match="file `amplitude/zarr.json` is made anew"):
        the_map(paper_scene, path)
    assert (path / "amplitude" / "zarr.json").read_bytes() == before
    flipped(path / store.CHECKSUMS, 100)
    with pytest.raises(ValueError, match="file `checksums` is not what was written"):
        the_map(paper_scene, path)


@pytest.mark.parametrize(
    "error", [MemoryError(), OSError(errno.EMFILE, "Too many open files")], ids=["memory", "files"]
)
def test_what_cannot_be_read_at_present_is_not_removed(paper_scene, tmp_path, jobs_run, monkeypatch, error):
    pytest.importorskip("zarr")
    path = tmp_path / "map.zarr"
    the_map(paper_scene, path)
    before = sorted(path.rglob("*"))

    class Unreadable(dict):
        def __getitem__(self, _):
            raise error

    recall = store.Store.recall

    def recalled(self, places):
        self.arrays = {name: Unreadable() for name in self.arrays}
        return recall(self, places)

    monkeypatch.setattr(store.Store, "recall", recalled)
    with pytest.raises(type(error)):
        the_map(paper_scene, path)
    assert sorted(path.rglob("*")) == before


def test_what_an_earlier_version_kept_is_recognised(paper_scene, tmp_path):
    """Before there were checksums, a checkpoint was a plain NetCDF file and a store a plain group."""
    file, folder = tmp_path / "map.part", tmp_path / "map.zarr"
    file.write_bytes(b"\x89HDF...fivjax checkpoint...")
    folder.mkdir()
    (folder / "zarr.json").write_text('{"attributes": {"kind": "fivjax store", "run": "{}"}}')
    with pytest.raises(ValueError, match="a version of fivjax wrote it that kept none"):
        the_map(paper_scene, file)
    pytest.importorskip("zarr")
    with pytest.raises(ValueError, match="a version of fivjax began it that kept none"):
        the_map(paper_scene, folder)


def test_a_damaged_job_file_is_not_used(tmp_path):
    path = tmp_path / "0.job"
    path.write_bytes(b"anything at all")
    with pytest.warns(UserWarning, match="of an unfinished job is damaged"):
        assert job_files.JobFile(str(path), "key").last() is None


def test_who_releases_a_lock_leaves_that_of_another_alone(tmp_path):
    """The folder of a run that is over is removed; then somebody else begins one."""
    jobs = tmp_path / "jobs"
    jobs.mkdir()
    lock = RunLock(jobs, "the first")
    shutil.rmtree(jobs)
    jobs.mkdir()
    other = RunLock(jobs, "the second")
    lock.remove()
    assert (jobs / LOCK).exists()
    with pytest.raises(ValueError, match="The third is being written by another process"):
        RunLock(jobs, "The third")
    other.remove()
    assert not (jobs / LOCK).exists()
