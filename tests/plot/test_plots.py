"""Pictures: drawn without touching pyplot, showing what they should, and refusing in sentences whose remedy works."""

import re
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
from matplotlib.figure import Figure

import fivjax as fj
from fivjax import plot
from fivjax.maps.axes import linear_limit
from fivjax.plot._windows import windows_of
from fivjax.plot.contact_status import KICK_HEIGHT
from fivjax.plot.cycles import _section as draw_section
from fivjax.plot.style import coordinate_label
from tests.helpers.general_coordinates import TURN, in_general_coordinates

SCENE = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.227), 1.0, fj.Pulse(100.0, 1.3, start=0.02))

TWO = fj.Structure(
    np.eye(4),
    np.eye(4),
    1e4 * np.eye(4),
    [0.0, -1.0, 0.0, -1.0],
    contacts=[fj.ContactPoint(0, 1), fj.ContactPoint(2, 3)],
)
ONE_AND_TWO_CONTACTS = fj.belt_oscillator(), TWO


@pytest.fixture(scope="module")
def runs():
    """Two trajectories with the layout of `simulate`: swings at 68 Hz, the first of them sticks and detaches."""
    t = np.arange(0.0, 0.6, 1e-3)
    wave = np.sin(2 * np.pi * 68 * t)[:, None] * [1e-3, 2e-3, 0.0]
    load = np.where((t >= 0.02) & (t < 0.12), 130.0, 100.0)
    made = {}
    for speed in (1.0, 3.0):
        status = (
            np.where(wave[:, 0] > 9e-4, 0, np.where(wave[:, 0] < -9e-4, 2, 1)) if speed == 1 else np.ones(len(t), int)
        )
        scene = SCENE.replace(belt_speed=speed)
        made[f"{speed:g} m/s"] = fj.Trajectory(t, wave, 400 * wave, 1e5 * wave, status, load, load, load, scene)
    return made


def still(**load) -> fj.Trajectory:
    """A trajectory of six rows that does not move, whose status changes."""
    t, zero = np.arange(6.0), np.zeros((6, 3))
    scene = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.1), 3.0, fj.Pulse(**load) if load else None)
    return fj.Trajectory(t, zero, zero, zero, np.array([1, 0, 1, 2, 2, 1]), t, t, np.full(6, 100.0), scene)


def a_map(**axes) -> xr.Dataset:
    """A dataset with the layout of `bistability_map`: sliding below p = 2.2, limit cycles of growing amplitude above."""
    axes = axes or {"mu": [0.1, 0.15, 0.2], "p": [1.5, 2.0, 2.5, 3.0]}
    shape = [len(values) for values in axes.values()]
    p = np.meshgrid(*axes.values(), indexing="ij")[list(axes).index("p")] if "p" in axes else np.ones(shape)
    cycle = p > 2.2
    others = tuple(name for name in axes if name != "p")
    over = [len(axes[name]) for name in others]
    return xr.Dataset(
        {
            "verdict": (tuple(axes), cycle.astype(np.int8)),
            "amplitude": (tuple(axes), np.where(cycle, p, 0.0)),
            "decided_at": (tuple(axes), p),
            "p_crit": (others, np.full(over, 2.25)),
            "p_crit_low": (others, np.full(over, 2.0)),
            "p_crit_high": (others, np.full(over, 2.5)),
        },
        coords=axes,
        attrs={"mu_crit": 0.228} if "mu" in axes else {},
    )


def a_threshold(p_crit=(3.0, 2.0, 1.5, 1.2), low=None, high=None) -> xr.Dataset:
    """A dataset with the layout of `critical_perturbation` over friction."""
    p_crit = np.asarray(p_crit, float)
    return xr.Dataset(
        {
            "p_crit": ("mu", p_crit),
            "p_crit_low": ("mu", p_crit - 1e-5 if low is None else np.asarray(low, float)),
            "p_crit_high": ("mu", p_crit + 1e-5 if high is None else np.asarray(high, float)),
            "only_crossing": ("mu", np.ones(len(p_crit), bool)),
            "crossings": ("mu", np.ones(len(p_crit), int)),
        },
        coords={"mu": np.linspace(0.1, 0.22, len(p_crit))},
        attrs={"range": "[1.0, 5.0]"},
    )


UNDECIDED = {"p_crit": [3.0, np.nan, 1.5, 1.2], "low": [2.9, 1.7, 1.4, 1.1], "high": [3.1, 2.6, 1.6, 1.3]}


def drawn(figure: Figure, tmp_path) -> bytes:
    assert isinstance(figure, Figure)
    return fj.save_figure(figure, tmp_path / "picture.png").read_bytes()


def texts(legend) -> list[str]:
    return [text.get_text() for text in legend.get_texts()]


def test_every_picture_draws(runs, tmp_path):
    """Each public picture function, written as PNG."""
    one = next(iter(runs.values()))
    for figure in (
        plot.response(one, "velocity", coordinate=1),
        plot.phase_plane(runs, last=0.2),
        plot.perturbation(one),
        plot.perturbation(one, zoom=0.2),
        plot.comparison(runs),
        plot.bistability(a_map(), value="decided_at"),
        plot.critical(a_threshold()),
    ):
        assert drawn(figure, tmp_path).startswith(b"\x89PNG")


@pytest.mark.slow
def test_pictures_of_computed_results(tmp_path):
    """The layouts that the other tests draw are those that maps and thresholds really have."""
    scene = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.2), 3.0, fj.Pulse(100.0, 1.2))
    computed = fj.bistability_map(scene, mu=[0.1, 0.15, 0.2], p=[1.5, 2.0, 2.5, 3.0], t_max=4.0, progress=False)
    assert set(a_map().data_vars) <= set(computed.data_vars)
    figure = plot.bistability(computed)
    (mesh,) = [c for c in figure.axes[0].collections if np.ma.count(c.get_array()) and c.get_cmap().name == "viridis"]
    expected = computed["amplitude"].values[computed["verdict"].values == 1]
    np.testing.assert_allclose(np.sort(np.ma.compressed(mesh.get_array())), np.sort(expected))
    drawn(figure, tmp_path)
    drawn(plot.response(fj.simulate(scene, 0.1, 1e-3)), tmp_path)
    found = fj.critical_perturbation(
        scene, mu=[0.15, 0.2], p_range=(1.0, 3.0), p_step=0.25, tolerance=1e-2, progress=False
    )
    assert set(a_threshold().data_vars) <= set(found.data_vars)
    drawn(plot.critical(found), tmp_path)


def test_amplitudes_reach_the_colour_scale():
    """The colour of a cell is its amplitude: the mesh holds the dataset's values."""
    computed = a_map()
    meshes = [c for c in plot.bistability(computed).axes[0].collections if c.get_array() is not None]
    expected = computed["amplitude"].values[computed["verdict"].values == 1]
    np.testing.assert_allclose(np.sort(np.ma.compressed(meshes[1].get_array())), np.sort(expected))


def test_the_map_picture_shows_boundary_and_undecided_trajectories():
    """The legend must name what is drawn: sliding, the boundary, and how many have no verdict."""
    undecided = a_map()
    undecided["verdict"][0, 0] = -1
    said = texts(plot.bistability(undecided).axes[0].get_legend())
    assert any("sliding" in text for text in said)
    assert any("p_" in text for text in said)
    assert any("(1 of 12)" in text for text in said)


def test_an_undecided_range_of_p_crit_is_a_bar_and_no_line():
    """Across undecided trajectories no line may be drawn: the bar ends at the kicks that are proved, as in the dataset."""
    found = a_threshold(**UNDECIDED)
    by_map = a_map(mu=found["mu"].values, p=[1.0, 2.0, 3.0, 4.0]).assign(
        {name: found[name] for name in ("p_crit", "p_crit_low", "p_crit_high")}
    )
    for figure in (
        plot.critical(found),
        plot.bistability(by_map),
        plot.bistability(by_map.drop_vars("p_crit"), critical=found),
    ):
        axes = figure.axes[0]
        bars = [c.get_segments() for c in axes.collections if type(c).__name__ == "LineCollection"]
        assert [np.asarray(segments).tolist() for segments in bars] == [[[[0.14, 1.7], [0.14, 2.6]]]]
        for line in axes.lines:
            at = np.isclose(np.asarray(line.get_xdata(), float), 0.14)
            assert not np.isfinite(np.asarray(line.get_ydata(), float)[at]).any() or line.get_linestyle() == "--"
        assert any("range" in text for text in texts(axes.get_legend()))
    certain = plot.critical(a_threshold()).axes[0]
    assert not [c for c in certain.collections if type(c).__name__ == "LineCollection"]


def test_the_critical_curve_marks_where_islands_were_seen():
    """Fig. 10: filled where the crossing is the only one, hollow elsewhere."""
    found = a_threshold()
    found["only_crossing"][0] = False
    assert texts(plot.critical(found).axes[0].get_legend()) == ["only crossing seen", "islands seen above"]


def test_the_limit_of_linear_theory_is_marked_whatever_the_other_axis():
    """A map over friction and belt speed has no p, yet μ_crit is where it was: a line on the axis of friction."""
    over_speed = a_map(mu=[0.1, 0.2, 0.3], belt_speed=[1.0, 2.0])
    for dataset, place in ((over_speed, 0), (over_speed.transpose("belt_speed", "mu"), 1)):
        (line,) = plot.bistability(dataset).axes[0].lines
        assert (line.get_xdata(), line.get_ydata())[place] == [0.228, 0.228]


@pytest.mark.parametrize(("speeds", "noted"), [([1.0, 2.0], True), ([-1.0, 2.0], False), ([0.0, 2.0], False)])
def test_the_limit_is_noted_over_belt_speeds_of_one_direction(speeds, noted):
    """Constant friction knows of a belt its direction alone: over several speeds the limit is one number."""
    attributes = linear_limit(SCENE, {"mu": np.array([0.1, 0.2, 0.3]), "belt_speed": np.array(speeds)})
    assert attributes == ({"mu_crit": pytest.approx(0.2282253477)} if noted else {})


def test_a_map_of_one_row_has_cells():
    """Where an axis has one value its cells have a width all the same: nothing is drawn with none."""
    figure = plot.bistability(a_map(mu=[0.2], p=[1.5, 2.0, 2.5, 3.0]))
    low, high = figure.axes[0].get_xlim()
    assert low < 0.2 < high
    (corners,) = {
        tuple(m.get_coordinates()[0, :, 0]) for m in figure.axes[0].collections if hasattr(m, "get_coordinates")
    }
    assert corners[0] < 0.2 < corners[1]


def test_statuses_are_shaded_where_they_occur(runs):
    """The legend of a response names what occurs in it, and only that."""
    assert texts(plot.response(runs["1 m/s"]).axes[0].get_legend()) == ["sticking", "detached", "kick, p = 1.3"]
    quiet = fj.Trajectory(**{**vars(still()), "status": np.ones(6, int)})
    assert plot.response(quiet).axes[0].get_legend() is None


def test_a_status_of_one_row_is_shaded_for_as_long_as_a_row_lasts():
    """A stick shorter than the distance of rows is seen, and shading ends where the next status begins."""
    axes = Figure().add_subplot()
    handles = plot.shade_status(axes, still())
    assert [handle.get_label() for handle in handles] == ["sticking", "detached"]
    parts = [path.get_extents() for bars in axes.collections for path in bars.get_paths()]
    assert [(part.x0, part.x1) for part in parts] == [(1, 2), (3, 5)]


def test_the_kick_is_marked_when_it_acts():
    """A response without a mark does not say when it was kicked; a kick of p = 1 is none."""
    kicked = still(force=100.0, p=1.2, duration=0.5, start=2.0)
    for figure in (plot.response(kicked), plot.comparison({"one": kicked})):
        axes = figure.axes[0]
        (mark,) = [c.get_paths()[0].get_extents() for c in axes.collections if len(c.get_paths()) == 1][-1:]
        assert (mark.x0, mark.x1, mark.y0, mark.y1) == (2.0, 2.5, 1 - KICK_HEIGHT, 1.0)
        assert "kick, p = 1.2" in texts(axes.get_legend())
    none = plot.response(still(force=100.0, p=1.0)).axes[0]
    assert "kick" not in " ".join(texts(none.get_legend()))


def test_a_short_kick_of_a_long_run_is_seen(runs):
    """Fig. 8: beside the whole run, a panel of which the kick takes a visible part; the load's axis does not begin at zero."""
    figure = plot.perturbation(runs["3 m/s"], zoom=0.2)
    around = figure.axes[0]
    low, high = around.get_xlim()
    assert low < 0.02 < 0.12 < high
    assert 0.1 / (high - low) > 0.4
    low, high = around.get_ylim()
    assert 30 / (high - low) > 0.5
    with pytest.raises(ValueError, match="`zoom` must be positive"):
        plot.perturbation(runs["3 m/s"], zoom=0)


def test_labels_name_coordinates():
    """An axis says which coordinate it shows, by name where the structure has names."""
    structure = fj.belt_oscillator()
    labels = [coordinate_label(structure, k) for k in range(3)]
    assert labels == ["tangential x2", "y1", "normal y2"]
    plain = fj.Structure(structure.mass, structure.damping, structure.stiffness, structure.load_direction)
    assert plot.response(still()).axes[0].get_ylabel() == f"{labels[0]}, acceleration (m/s²)"
    assert coordinate_label(plain, 1) == "q1"


def test_names_of_methods_do_not_collide():
    """Work and precision: methods are told apart by markers and named in a legend, not in labels one upon the other."""
    names = [f"method {k}" for k in range(7)]
    table = xr.Dataset(
        {
            "cost": (("stepper", "precision"), np.full((7, 2), 1e-6)),
            "state_error": (("stepper", "precision"), np.full((7, 2), 1e-9)),
        },
        coords={"stepper": names, "precision": ["float64", "float32"]},
    )
    figure = plot.tradeoff(table)
    assert not figure.axes[0].texts
    assert texts(figure.legends[0]) == [*names, "hollow: float32"]
    assert len({line.get_marker() for line in figure.axes[0].lines}) == 7
    figure.draw_without_rendering()


def test_a_map_over_one_axis_is_a_curve_of_what_is_reached():
    m = a_map(mu=[0.1, 0.15, 0.2])
    m["verdict"].values[:] = fj.Verdict.SLIDING, fj.Verdict.UNDECIDED, fj.Verdict.LIMIT_CYCLE
    m["amplitude"].values[:] = np.nan, np.nan, 2.5
    figure = plot.bistability(m)
    points = {line.get_label(): (list(line.get_xdata()), list(line.get_ydata())) for line in figure.axes[0].lines}
    assert points["limit cycle"] == ([0.2], [2.5]) and points["returns to sliding"] == ([0.1], [0.0])
    assert points["no verdict (1 of 3)"] == ([0.15], [0.0])
    figure.draw_without_rendering()


# --- refusals


def test_shares_of_a_part_of_basins_are_those_of_the_part():
    """Of the whole, a quarter slides; of the part with the smaller friction, half."""
    verdict, attractor = np.zeros((2, 2, 2), np.int8), np.full((2, 2, 2), -1)
    verdict[1], verdict[0, 0] = 1, 1
    attractor[verdict == 1] = 0
    dims = ("mu", "x2", "dx2")
    whole = xr.Dataset(
        {
            "verdict": (dims, verdict),
            "attractor": (dims, attractor),
            "share": ("attractors", [0.75]),
            "sliding_share": 0.25,
            "attractor_kind": ("attractors", ["cycle"]),
            "attractor_amplitude": ("attractors", [1.5]),
        },
        {"mu": [0.1, 0.2], "x2": [0.0, 1.0], "dx2": [0.0, 1.0]},
    )
    legend = plot.basins(whole.isel(mu=0)).axes[0].get_legend()
    assert [text.get_text() for text in legend.get_texts()] == ["slides: 50.0 %", "cycle, 1.5 m/s: 50.0 %"]


@pytest.mark.parametrize(
    ("draw", "sentence"),
    [
        (lambda runs: plot.bistability(a_map(), value="p_crit"), "must be over mu and p, as the verdicts are"),
        (lambda runs: plot.bistability(a_map().isel(mu=slice(0, 0))), "needs values along its axes"),
        (lambda runs: plot.energy.slip_reversal(runs, {"other": (0.1, 0.2)}), "by the labels of `runs`"),
        (lambda runs: plot.energy.slip_reversal(next(iter(runs.values())), (0.1, 0.2)), "trajectories by label"),
    ],
)
def test_what_a_picture_cannot_be_made_of_is_told(draw, sentence, runs):
    with pytest.raises((ValueError, TypeError), match=sentence):
        draw(runs)


def test_one_window_needs_no_list():
    pair, two = (0.1, 0.2), [(0.1, 0.2), (0.3, 0.4)]
    assert windows_of(pair) == windows_of([pair]) == windows_of(np.array(pair)) == [pair]
    assert windows_of(np.array(two)) == windows_of(two) == two
    with pytest.raises(ValueError, match="must be a list of windows"):
        windows_of([])
    assert windows_of(iter(two)) == two
    for wrong in ((0.2, 0.1), (0.1, np.nan), [0.1, 0.2, 0.3], [(0.1, 0.2), (0.3,)], None, 0.5):
        with pytest.raises(ValueError, match="each a start and a later end"):
            windows_of(wrong)


def test_a_stacked_map_is_drawn_unstacked():
    with pytest.raises(
        ValueError, match=r"`point` has none. A map that was stacked is drawn as it was before: `m.unstack\(\)`"
    ):
        plot.bistability(a_map().stack(point=["mu", "p"]))


def test_a_slice_of_a_map_is_selected_by_the_call_that_the_sentence_gives():
    """Three axes: the call in the sentence is carried out, and draws."""
    m = a_map(mu=[0.1, 0.2], p=[1.5, 2.5], belt_speed=[1.5, 2.5])
    with pytest.raises(ValueError, match="two axes at most, but this map has 3: mu, p, belt_speed") as refused:
        plot.bistability(m)
    (call,) = re.findall(r"`(fj\.plot\.bistability\(.*?\))`;", str(refused.value))
    assert isinstance(eval(call, {"fj": fj, "m": m}), Figure)
    with pytest.raises(ValueError, match="this map has none"):
        plot.bistability(m.isel(mu=0, p=0, belt_speed=0))
    found = a_threshold().expand_dims(belt_speed=[1.0, 2.0]).transpose("mu", "belt_speed")
    with pytest.raises(ValueError, match="over 2: mu, belt_speed") as refused:
        plot.critical(found)
    (call,) = re.findall(r"`(fj\.plot\.critical\(.*?\))`\.", str(refused.value))
    assert isinstance(eval(call, {"fj": fj, "found": found}), Figure)


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda: plot.bistability(None), r"what `fj.bistability_map\(scene, .*\)` returns, but is None"),
        (lambda: plot.bistability(a_map(), critical=3), r"what `fj.critical_perturbation\(.*\)` returns, but is 3"),
        (lambda: plot.bistability(a_threshold()), "a dataset without `verdict`"),
        (lambda: plot.bistability(a_map(), value="size"), "a dataset without `size`"),
        (lambda: plot.critical(a_map()), "a dataset without `only_crossing`"),
        (lambda: plot.response(a_map()), r"as `fj.simulate` returns it, but is a dataset.*`fj.show\(dataset\)`"),
        (lambda: plot.response(None), "such as `fj.simulate.*` returns, but is None"),
        (lambda: plot.phase_plane([1.0]), "must be a trajectory"),
        (lambda: plot.perturbation(a_map()), "is a dataset"),
        (lambda: plot.comparison(still()), "trajectories by label"),
        (lambda: plot.comparison({}), "is empty"),
        (lambda: plot.tradeoff(a_map()), r"what `fj.tradeoff\(scene\)` returns"),
        (lambda: plot.energy.balance(None), "must be a trajectory"),
        (lambda: plot.energy.balance(still()), r"`simulate\(..., energy=True\)`"),
        (lambda: plot.energy.per_cycle(a_map()), r"what `fj.energy_per_cycle\(run\)` returns"),
        (lambda: plot.calibration(None), r"what `fj.calibrate\(.*\)` returns, but is None"),
        (lambda: plot.calibration(a_map()), "a dataset without `offset`"),
        (lambda: plot.response(still(), "speed"), "`quantity` must be one of"),
        (lambda: plot.response(still(), coordinate=3), "`coordinate` must be at most 2, but is 3"),
        (lambda: plot.response(still(), coordinate="x2"), "`coordinate` must be a whole number"),
        (lambda: plot.energy.growth(None, None, (0.0, 1.0)), "must be a trajectory"),
        (lambda: plot.energy.growth(still(), None, (0.0, 1.0), "work"), "`per_cycle` must be one of"),
        (lambda: plot.energy.growth(still(), None, [(0.0, 1.0)]), "`window` must be a start and a later end"),
        (lambda: plot.energy.growth(still(), None, (1.0, 0.0)), "`window` must be a start and a later end"),
    ],
)
def test_wrong_objects_are_refused_with_the_call_that_makes_right_ones(call, sentence):
    with pytest.raises((TypeError, ValueError), match=sentence):
        call()


def test_pictures_leave_pyplot_alone():
    """Importing fivjax must not import pyplot, whose state is global."""
    code = "import sys, fivjax, fivjax.plot; sys.exit('matplotlib.pyplot' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], timeout=120).returncode == 0


def test_runs_of_a_contact_given_by_vectors_are_drawn_along_its_belt():
    structure = in_general_coordinates(fj.belt_oscillator())
    run = fj.simulate(fj.Scene(structure, fj.Coulomb(0.2), 1.0, fj.Pulse(100.0, 1.2)), 0.02, 1e-3)
    expected = run.acceleration @ TURN[0]
    for figure in (fj.show(run), fj.plot.response(run), fj.plot.comparison({"a": run})):
        np.testing.assert_allclose(figure.axes[0].lines[0].get_ydata(), expected)
    np.testing.assert_allclose(fj.plot.perturbation(run).axes[1].lines[0].get_ydata(), expected)


@pytest.mark.parametrize("structure", [in_general_coordinates(fj.belt_oscillator()), *ONE_AND_TWO_CONTACTS])
def test_the_points_of_a_torus_are_drawn_along_the_belt_of_the_contact_shown(structure):
    points = np.random.default_rng(0).normal(size=(5, 2 * structure.size))
    axes, contact = Figure().subplots(), len(structure.contacts) - 1
    draw_section(axes, SimpleNamespace(scene=SimpleNamespace(structure=structure), points=points), contact)
    expected = 1e3 * points[:, : structure.size] @ structure.tangential_directions[:, contact]
    np.testing.assert_array_equal(axes.lines[0].get_xdata(), expected)


def test_upwards_is_what_moves_on_the_section():
    """Of two coordinates the tangential one has no velocity there."""
    structure = fj.Structure(np.eye(2), np.eye(2), 1e4 * np.eye(2), [0.0, -1.0], tangential=0, normal=1)
    points, axes = np.random.default_rng(0).normal(size=(5, 4)), Figure().subplots()
    draw_section(axes, SimpleNamespace(scene=SimpleNamespace(structure=structure), points=points), 0)
    np.testing.assert_array_equal(axes.lines[0].get_ydata(), points[:, 3])
