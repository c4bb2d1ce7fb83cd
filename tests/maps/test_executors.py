"""Who runs a map's jobs: any executor gives the same map, and workers may die."""

import multiprocessing
import pickle
import threading
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor, ThreadPoolExecutor

import numpy as np
import pytest

import fivjax as fj
from fivjax.maps import engine, plan
from fivjax.maps.executors import Workers, hand_out
from fivjax.maps.plan import Grid, TrajectoryList
from tests.helpers import stand_in_jobs

AXES = {"mu": np.linspace(0.1, 0.2, 5), "p": np.linspace(1.0, 3.0, 7), "belt_speed": np.array([1.0, 2.0, 3.0])}


@pytest.mark.parametrize("most", [1, 3, 7, 20, 1000])
def test_every_trajectory_is_in_one_job(most):
    """A job that lacked one, or shared one, would leave a hole in the map or write a chunk twice."""
    grid = Grid(AXES)
    some = np.random.default_rng(0).choice(grid.total, 40, replace=False)
    listed = TrajectoryList(grid.columns())
    for jobs, places in ((grid.jobs(None, most), np.arange(grid.total)), (grid.jobs(some, most), some)):
        np.testing.assert_array_equal(np.sort(np.concatenate(list(jobs))), np.sort(places))
        assert max(map(len, jobs)) <= most
    jobs = listed.jobs(None, most)
    np.testing.assert_array_equal(np.sort(np.concatenate(jobs)), np.arange(grid.total))
    assert max(map(len, jobs)) <= most
    # A group of 7 kicks is in one job where it fits.
    for one in (grid, listed):
        for own in one.jobs(None, most) if most >= 7 else ():
            assert np.all(np.unique(one.groups(own), return_counts=True)[1] == 7)
    np.testing.assert_array_equal(grid.columns(some)["mu"], grid.columns()["mu"][some])


class Deadly:
    """A pool of two workers that is lost, with all that is pending, whenever one of its jobs kills its worker."""

    _max_workers = 2

    def __init__(self, kills, made):
        self.kills, self.broken, self.pending, self.lock = kills, False, [], threading.RLock()
        made.append(self)

    def submit(self, function, number):
        if self.broken:
            raise BrokenExecutor
        future = Future()
        with self.lock:
            self.pending.append((future, number))
        if len(self.pending) > self._max_workers:  # both workers have begun, and one has come to its end
            self.work()
        else:
            threading.Timer(0.005, self.work).start()
        return future

    def work(self):
        with self.lock:
            self.one_comes_to_its_end()

    def one_comes_to_its_end(self):
        if self.broken or not self.pending:
            return
        if any(self.kills(number) for _, number in self.pending[: self._max_workers]):
            self.broken = True
            for future, _ in self.pending:
                future.set_exception(BrokenExecutor())
        else:
            future, number = self.pending.pop(0)
            future.set_result(number**2)
            if self.pending:
                threading.Timer(0.005, self.work).start()

    def shutdown(self, **_):
        pass


def handed_out(count, kills):
    made, results, given_up = [], {}, []
    workers = Workers(lambda: Deadly(kills, made))

    def done(number, result):
        assert number not in results
        results[number] = result

    hand_out(range(count), lambda n: workers.submit(None, n), workers, done, given_up.append, lambda: False)
    assert sorted([*results, *given_up]) == list(range(count))
    return results, given_up, made


def test_a_job_that_kills_whoever_runs_it_is_given_up_and_costs_no_other():
    results, given_up, made = handed_out(12, lambda number: number == 5)
    assert given_up == [5] and results == {n: n**2 for n in range(12) if n != 5}
    assert len(made) <= 1 + 2 * 3


def test_workers_that_die_of_something_else_cost_no_job():
    """Twenty kills at random, as by a machine that is short of memory."""
    rng, kills = np.random.default_rng(1), [20]

    def killed(_):
        hit = kills[0] > 0 and rng.random() < 0.4
        kills[0] -= hit
        return hit

    results, given_up, made = handed_out(30, killed)
    assert given_up == [] and len(results) == 30 and len(made) > 10


def test_workers_that_all_die_end_the_run_in_a_sentence():
    with pytest.raises(RuntimeError, match='if __name__ == "__main__"'):
        handed_out(50, lambda _: True)


def test_a_pool_that_cannot_be_made_anew_says_how_it_could():
    made = []
    workers = Workers(Deadly(lambda _: True, made))
    with pytest.raises(RuntimeError, match="Give a function that makes one"):
        hand_out([0, 1], lambda n: workers.submit(None, n), workers, print, print, lambda: False)


def test_results_that_have_come_by_an_interrupt_are_kept():
    """Of an executor whose number of workers is not known, many jobs are out at once."""
    results, stopped = {}, []

    class Quick:
        def submit(self, function, number):
            future = Future()
            future.set_result(function(number))
            stopped.append(number)
            return future

    workers = Workers(Quick())
    with pytest.raises(KeyboardInterrupt):
        hand_out(
            range(9), lambda n: workers.submit(abs, n), workers, results.__setitem__, print, lambda: len(stopped) > 4
        )
    assert results == {number: number for number in range(9)}


def test_a_scene_that_cannot_be_sent_to_workers_is_refused():
    def submit(_):
        future = Future()
        future.set_exception(pickle.PicklingError("Can't pickle <lambda>"))
        return future

    with ThreadPoolExecutor(1) as pool, pytest.raises(ValueError, match="Define its classes and functions in a module"):
        hand_out([0], submit, Workers(pool), print, print, lambda: False)


def test_what_a_job_raises_ends_the_run():
    with ThreadPoolExecutor(1) as pool:
        workers = Workers(pool)
        with pytest.raises(ZeroDivisionError):
            hand_out([0], lambda n: workers.submit(lambda: 1 / n), workers, print, print, lambda: False)


def test_a_worker_without_the_kernels_of_the_others_is_refused(paper_scene):
    """It would compute by XLA, forty times as slowly, and rounded otherwise."""

    class Elsewhere(ThreadPoolExecutor):
        def submit(self, function, *args):
            def there():
                with pytest.MonkeyPatch.context() as patch:
                    patch.setattr("fivjax.maps.groups.has_kernel", lambda *_, **__: False)
                    return function(*args)

            return super().submit(there)

    with Elsewhere(1) as pool, pytest.raises(RuntimeError, match=r"followed by kernels .* has none\. Install"):
        fj.bistability_map(paper_scene, p=[1.0, 2.0], executor=pool, progress=False)


@pytest.mark.parametrize(
    ("executor", "error", "fragment"),
    [
        (2, TypeError, "must be an executor"),
        (lambda: 2, TypeError, "what it made is"),
    ],
)
def test_what_is_no_executor_is_refused(paper_scene, executor, error, fragment):
    with pytest.raises(error, match=fragment):
        fj.bistability_map(paper_scene, p=[1.0, 2.0], executor=executor, progress=False)


def test_workers_that_are_copies_of_this_process_are_refused(paper_scene):
    """JAX has threads, which a fork does not copy: the copy would wait for them for ever."""
    pool = ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("fork"))
    for executor in (pool, lambda: pool):
        with pytest.raises(ValueError, match="spawn"):
            fj.bistability_map(paper_scene, p=[1.0, 2.0], executor=executor, progress=False)
    pool.shutdown()


def test_processes_give_the_map_of_threads_although_one_is_killed(paper_scene, tmp_path, monkeypatch):
    """Jobs cross the border between processes, and a broken pool is made anew; what each job computes is stood in for."""
    monkeypatch.setenv("FIVJAX_TEST_KILLED", str(tmp_path))
    monkeypatch.setattr(plan, "IN_A_JOB", 7)
    monkeypatch.setattr(engine, "run_job", stand_in_jobs.killing_once)
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        m = fj.bistability_map(paper_scene, executor=pool, progress=False, mu=[0.1, 0.2], p=np.linspace(1, 3, 7))
    assert (tmp_path / "killed").exists()
    mu, p = np.meshgrid(m["mu"], m["p"], indexing="ij")
    np.testing.assert_array_equal(m["amplitude"], np.sin(p) * mu)
    np.testing.assert_array_equal(m["verdict"], p > 2)


def same(one, other) -> bool:
    return all(one[name].values.tobytes() == other[name].values.tobytes() for name in one.data_vars)


@pytest.mark.slow
def test_threads_processes_and_dask_give_the_same_bits(paper_scene, monkeypatch, tmp_path):
    distributed = pytest.importorskip("distributed")
    axes = {"mu": [0.1, 0.15, 0.2, 0.227], "p": np.linspace(1.0, 3.0, 9), "duration": [0.1, 0.2]}
    whole = fj.bistability_map(paper_scene, progress=False, **axes)
    # Whole groups, and groups that are cut.
    for most in (18, 7):
        monkeypatch.setattr(plan, "IN_A_JOB", most)
        assert same(fj.bistability_map(paper_scene, progress=False, **axes), whole)
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as pool:
        assert same(fj.bistability_map(paper_scene, progress=False, executor=pool, **axes), whole)
    with (
        distributed.LocalCluster(2, threads_per_worker=1, dashboard_address=None) as cluster,
        distributed.Client(cluster) as client,
    ):
        for executor in (client, client.get_executor(retries=2)):
            assert same(fj.bistability_map(paper_scene, progress=False, executor=executor, **axes), whole)
        # Files are written beside a client, which xarray would ask for a lock.
        kept = fj.bistability_map(paper_scene, progress=False, executor=client, resume=tmp_path / "map.part", **axes)
        assert same(kept, whole)
        assert same(fj.open(fj.save(kept, tmp_path / "map.nc"))[["verdict", "amplitude"]], whole)
