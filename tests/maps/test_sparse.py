"""Sparse maps: the points that a refined map has computed, the parts of the grid made of them, and what is kept on the disk."""

import contextlib
import itertools
import json
import re
import signal

import numpy as np
import pytest
import xarray as xr
from scipy.ndimage import binary_dilation

import fivjax as fj
from fivjax.maps import engine, jobs, plan
from fivjax.maps.checkpoint import Checkpoint
from fivjax.maps.refinement import refine_grid
from fivjax.maps.results import by_name, not_run

MU, P = np.linspace(0.15, 0.225, 4), np.linspace(1.0, 3.0, 5)


@pytest.fixture
def scene() -> fj.Scene:
    return fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.2), 1.0, fj.Pulse(100.0, p=1.2))


def refined_whole(truth, halvings):
    """The same refinement on arrays of the whole grid: what each point takes, and which are computed."""
    inside = [slice(None, None, 2**halvings if length > 1 else 1) for length in truth.shape]
    values, computed = truth[tuple(inside)], np.ones_like(truth[tuple(inside)], bool)
    for level in reversed(range(halvings)):
        corners = [slice(None, -1), slice(1, None)]
        ways = [corners if length > 1 else [slice(None)] for length in values.shape]
        parts = [values[way] for way in itertools.product(*ways)]
        differ = np.min(parts, axis=0) != np.max(parts, axis=0)
        ringed = binary_dilation(differ, np.ones([3 if length > 1 else 1 for length in values.shape]))
        step = tuple(slice(None, None, 2**level if length > 1 else 1) for length in truth.shape)
        finer = truth[step]
        before = values[np.ix_(*(np.arange(length) // 2 for length in finer.shape))]
        wanted = np.zeros(finer.shape, bool)
        for at in np.argwhere(ringed):
            wanted[tuple(slice(2 * k, 2 * k + 3) for k in at)] = True
        old = tuple(slice(None, None, 2) for _ in finer.shape)
        wanted[old] &= ~computed
        before[old] = values
        computed, earlier = wanted.copy(), computed
        computed[old] |= earlier
        values = np.where(wanted, finer, before)
    return values, computed


@pytest.mark.parametrize("shape", [(9,), (4, 7), (1, 6), (3, 1, 4), (3, 4, 3)])
def test_only_boundaries_are_looked_at_and_yet_it_is_the_refinement_of_the_whole_grid(shape):
    rng, halvings = np.random.default_rng(len(shape)), 3
    fine = [(length - 1) * 2**halvings + 1 for length in shape]
    grids = np.meshgrid(*(np.linspace(-1, 1, length) for length in fine), indexing="ij")
    for _ in range(4):
        truth = sum(np.sin(rng.uniform(0, 5) * grid + rng.uniform(0, 6)) for grid in grids) > rng.normal()

        def run(places, what, truth=truth):
            verdicts = not_run(len(places), energy=False)
            verdicts.verdict[:] = verdicts.amplitude[:] = truth.ravel()[places]
            return verdicts

        refined, verdicts, _ = refine_grid(truth.shape, halvings, 0.0, run)
        values, computed = refined_whole(truth.astype(int), halvings)
        np.testing.assert_array_equal(refined.places, np.flatnonzero(computed))
        np.testing.assert_array_equal(verdicts.verdict[refined.every_row()], values.ravel())


def test_a_grid_of_ten_thousand_million_points_takes_the_memory_of_its_boundary():
    """A small circle, to within one of a hundred thousand intervals; the audit draws from all the other points."""
    side, audited = 50 * 2**11 + 1, []

    def run(places, what):
        x, y = (index / (side - 1) for index in np.unravel_index(places, (side, side)))
        verdicts = not_run(len(places), energy=False)
        verdicts.verdict[:] = verdicts.amplitude[:] = x**2 + y**2 < 0.005
        if what == "audit":
            audited.append(len(places))
        return verdicts

    refined, verdicts, checked = refine_grid((side, side), 11, 1e-6, run)
    assert len(refined.places) < 2 * side and checked.wrong == 0
    assert audited == [checked.cells] == [int(np.ceil(1e-6 * (side**2 - len(refined.places) + checked.cells)))]
    # Where the circle meets a row of the grid.
    rows = np.random.default_rng(0).integers(0, int(0.07 * side), 50)
    along = np.sqrt(0.005 * (side - 1) ** 2 - rows**2)
    for shift in (-1, 0, 1, 2):
        columns = np.floor(along).astype(int) + shift
        found = verdicts.verdict[refined.rows(rows * side + columns)]
        np.testing.assert_array_equal(found, shift <= 0)


def test_a_window_of_all_is_the_refined_map(scene):
    whole = fj.bistability_map(scene, mu=MU, p=P, refine=2, audit=0.1, progress=False)
    sparse = fj.bistability_map(scene, mu=MU, p=P, refine=2, audit=0.1, sparse=True, progress=False)
    again = fj.window(sparse)
    assert set(again.variables) == set(whole.variables)
    for name in whole.variables:
        assert again[name].variable.identical(whole[name].variable), name
    assert {name: again.attrs[name] for name in whole.attrs if name not in ("summary", "created")} == {
        name: value for name, value in whole.attrs.items() if name not in ("summary", "created")
    }
    assert sparse.sizes["point"] == int(whole["computed"].sum())
    assert int((sparse["step"] == 0).sum()) == whole.attrs["audit_cells"]


def test_windows_have_bounds_and_as_many_points_as_are_asked_for(scene, tmp_path):
    sparse = fj.bistability_map(scene, mu=MU, p=P, refine=2, sparse=True, progress=False)
    sparse = fj.open(fj.save(sparse, tmp_path / "map.nc"))
    whole, part = fj.window(sparse), fj.window(sparse, mu=(0.18, 0.21), p=(2.0, 2.0))
    inside = whole.sel(mu=slice(0.18, 0.21), p=[2.0])
    for name in ("verdict", "amplitude", "attractor", "computed"):
        assert part[name].equals(inside[name]), name
    # In whatever order somebody has put the points.
    assert fj.window(sparse.sortby("p")).equals(whole) and fj.window(sparse.sortby("amplitude")).equals(whole)
    # A number of the structure may be called `p`: then it is no kick.
    said = json.loads(sparse.attrs["scene"]) | {"of_load": []}
    assert "p_crit" in whole and "p_crit" not in fj.window(sparse.assign_attrs(scene=json.dumps(said)))
    few = fj.window(sparse, most=5)
    assert dict(few["verdict"].sizes) == {"mu": 4, "p": 5}
    assert few["verdict"].equals(whole["verdict"][::4, ::4])
    assert json.loads(few.attrs["counts"])["limit_cycle"] == int((few["verdict"] == 1).sum())
    for low in (2.6, 2.7, 2.8):
        assert fj.window(sparse, p=(low, 3.0), most=1)["p"].size == 1


def test_what_is_no_sparse_map_or_not_on_its_axes_is_refused(scene):
    sparse = fj.bistability_map(scene, mu=[0.1, 0.2], p=[1.0, 2.0], refine=1, sparse=True, progress=False)
    for bounds, sentence in (
        ({"mu": (1.0, 2.0)}, "Argument `mu` must hold values of the axis, which goes from 0.1 to 0.2 in 2 steps"),
        ({"mu": 0.1}, "Argument `mu` must be a least and a greatest value, in this order, but is 0.1"),
        ({"mu": (0.2, 0.1)}, r"a least and a greatest value, in this order, but is \(0.2, 0.1\)"),
        ({"mu": (0.1, np.nan)}, r"a least and a greatest value, in this order, but is \(0.1, nan\)"),
        ({"m": (0.1, 0.2)}, "Unknown axis `m`; this map has: mu, p."),
    ):
        with pytest.raises(ValueError, match=sentence):
            fj.window(sparse, **bounds)
    for part in (sparse.isel(point=slice(1, None)), sparse.where(sparse["verdict"] == 1), sparse.isel(point=[])):
        with pytest.raises(ValueError, match=r"must have all 9 points that were computed.* Take the window first"):
            fj.window(part)
    with pytest.raises(
        ValueError, match=r"must be a sparse map, but has the dimensions mu, p, attractors. Make one by"
    ):
        fj.window(fj.window(sparse))
    with pytest.raises(ValueError, match=r"`fj.plot.bistability\(fj.window\(m\)\)`"):
        fj.plot.bistability(sparse)
    with pytest.raises(ValueError, match="`sparse` is for maps that are refined: give `refine`"):
        fj.bistability_map(scene, p=[1.0, 2.0], sparse=True)
    with pytest.raises(ValueError, match="must be a file for a sparse map, but is the folder"):
        fj.bistability_map(scene, p=[1.0, 2.0], refine=1, sparse=True, resume="map.zarr")
    fine = np.linspace(1.0, 2.0, 100)
    with pytest.raises(ValueError, match="make several maps or one with `sparse=True`"):
        fj.bistability_map(scene, mu=fine / 10, p=fine, refine=10)
    with pytest.raises(ValueError, match=r"which is more than can be numbered. Give a smaller `refine`"):
        fj.bistability_map(scene, mu=fine / 10, p=fine, refine=26, sparse=True)


@pytest.mark.slow
def test_an_interrupted_sparse_map_goes_on_from_its_file(scene, tmp_path, monkeypatch):
    """In the coarse grid, and in a halving: what is finished is on the disk, and only that; the end is the same, bit for bit."""
    monkeypatch.setattr(plan, "IN_A_JOB", 8)
    monkeypatch.setattr("fivjax.maps.checkpoint.KEEP_EVERY", 0.0)
    # One job after the other, so that those before the interrupt are done.
    monkeypatch.setattr(engine, "cores", lambda: 1)
    options = {"mu": MU, "p": P, "refine": 2, "sparse": True, "audit": 0.1, "progress": False}
    whole, path = fj.bistability_map(scene, **options), tmp_path / "map.part"
    real, left = jobs.follow_all, []

    def until_none_is_left(*args):
        if not left:
            raise KeyboardInterrupt
        left.pop()
        return real(*args)

    monkeypatch.setattr(jobs, "follow_all", until_none_is_left)
    for count in (1, 7):
        left[:] = [1] * count
        with pytest.warns(UserWarning, match="Interrupted"):
            part = fj.bistability_map(scene, **options, resume=path)
        done = part["verdict"].values != fj.Verdict.NOT_RUN
        assert 0 < done.sum() < whole.sizes["point"]
        with xr.open_dataset(path, engine="h5netcdf") as kept:
            assert set(kept["place"].values) <= set(part["place"].values[done])
        # Points of halvings that are not begun were not run, on a window either.
        finer = fj.window(part)["verdict"].values
        assert np.sum(finer != fj.Verdict.NOT_RUN) >= done.sum() and np.any(finer == fj.Verdict.NOT_RUN)
    left[:] = [1] * 1000
    again = fj.bistability_map(scene, **options, resume=path)
    assert again.equals(whole)
    monkeypatch.setattr(jobs, "follow_all", None)
    assert fj.bistability_map(scene, **options, resume=path).equals(whole)
    assert [entry.name for entry in tmp_path.iterdir()] == ["map.part"]
    with pytest.raises(ValueError, match="is of another run: its `sparse` is true"):
        fj.bistability_map(scene, **options | {"sparse": False}, resume=path)


def test_a_signal_while_a_level_is_written_ends_the_map(scene, tmp_path, monkeypatch):
    """All of the coarse grid is run by then; the halvings are not."""
    real, written = Checkpoint.flush, []

    def flush(self):
        if not written:
            signal.raise_signal(signal.SIGINT)
        written.append(1)
        return real(self)

    monkeypatch.setattr(Checkpoint, "flush", flush)
    options = {"mu": MU, "p": P, "refine": 2, "sparse": True, "progress": False, "resume": tmp_path / "map.part"}
    # Threads that other tests have interrupted may end in a `catch_warnings`, which takes away what pytest records.
    said: list[str] = []
    with monkeypatch.context() as patched:
        patched.setattr(engine.warnings, "warn", lambda message, **_: said.append(message))
        part = fj.bistability_map(scene, **options)
    assert re.fullmatch("Interrupted: of .* trajectories, .* without a verdict.*", said[0])
    coarse = np.isin(part["mu"], MU) & np.isin(part["p"], P)
    np.testing.assert_array_equal(part["verdict"] != fj.Verdict.NOT_RUN, coarse)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert not np.any(fj.bistability_map(scene, **options)["verdict"] == fj.Verdict.NOT_RUN)


def test_damaged_results_of_a_sparse_map_count_as_not_run(tmp_path):
    rng, path = np.random.default_rng(0), tmp_path / "map.part"
    places = np.unique(rng.integers(0, 10**10, 5000))
    verdicts = not_run(len(places), energy=False)
    for values in by_name(verdicts).values():
        values[:] = rng.integers(0, 2, len(places))
    kept = Checkpoint(path, {"of": 1}, 10**10, False)

    def recalled(path):
        with contextlib.closing(Checkpoint(path, {"of": 1}, 10**10, False)) as again:
            return again.recall(places)

    for part in np.array_split(rng.permutation(len(places)), 3):
        part = np.sort(part)
        kept.keep(
            places[part], type(verdicts)(*(leaf if isinstance(leaf, dict) else leaf[part] for leaf in verdicts)), {}
        )
    kept.flush()
    kept.close()
    same = recalled(path)
    for ours, theirs in zip(by_name(same).values(), by_name(verdicts).values(), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    with xr.open_dataset(path, engine="h5netcdf") as dataset:
        stored = dataset["place"].values.tobytes(), dataset["amplitude"].values.tobytes()
    for values in stored:
        data = bytearray(path.read_bytes())
        data[data.index(values) + 8 * 3000] ^= 1
        damaged = tmp_path / "damaged.part"
        damaged.write_bytes(bytes(data))
        with pytest.warns(UserWarning, match="is damaged: the `(place|amplitude)` in its rows 2048 to 3071"):
            found = recalled(damaged)
        lost = np.flatnonzero(found.pending())
        assert lost.tolist() == list(range(2048, 3072))
        whole = np.flatnonzero(~found.pending())
        np.testing.assert_array_equal(found.amplitude[whole], verdicts.amplitude[whole])
