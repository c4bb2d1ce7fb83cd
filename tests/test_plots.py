"""Pictures: drawn from real results, without touching pyplot, and showing what they should."""

import sys

import numpy as np
import pytest
from matplotlib.figure import Figure

import fivjax as fj
from fivjax.plot import results as plot


@pytest.fixture(scope="module")
def runs():
    scene = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.227), 1.0, fj.Pulse(100.0, 1.3, start=0.02))
    return {f"{v:g} m/s": fj.simulate(scene.replace(belt_speed=v), 0.6, 1e-3) for v in (1.0, 3.0)}


@pytest.fixture(scope="module")
def a_map():
    scene = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.2), 3.0, fj.Pulse(100.0, 1.2))
    return fj.bistability_map(scene, mu=[0.1, 0.15, 0.2], p=[1.5, 2.0, 2.5, 3.0], t_max=4.0, progress=False)


def drawn(figure: Figure, tmp_path) -> bytes:
    assert isinstance(figure, Figure)
    return fj.save_figure(figure, tmp_path / "picture.png").read_bytes()


def test_every_picture_draws(runs, a_map, tmp_path):
    """Each public picture function on real results, written as PNG."""
    one = next(iter(runs.values()))
    for figure in (
        plot.response(one),
        plot.response(one, "velocity", coordinate=1),
        plot.phase_plane(one, last=0.2),
        plot.phase_plane(runs, last=0.2),
        plot.perturbation(one),
        plot.comparison(runs),
        plot.bistability(a_map),
        plot.bistability(a_map, value="decided_at"),
    ):
        assert drawn(figure, tmp_path).startswith(b"\x89PNG")


def test_the_map_picture_shows_boundary_and_undecided_lanes(a_map, tmp_path):
    """The legend must name what is drawn: sliding, the boundary, and how many lanes have no verdict."""
    undecided = a_map.copy(deep=True)
    undecided["verdict"][0, 0] = -1
    legend = plot.bistability(undecided).axes[0].get_legend()
    texts = [text.get_text() for text in legend.get_texts()]
    count = int((undecided["verdict"] < 0).sum())
    assert any("sliding" in text for text in texts)
    assert any("p_" in text for text in texts)
    assert any(f"({count} of 12)" in text for text in texts)


def test_statuses_are_shaded_where_they_occur(runs):
    """The legend of a response names the statuses that occur in it, and only those."""
    sticking = plot.response(runs["1 m/s"]).axes[0].get_legend()
    assert "sticking" in [text.get_text() for text in sticking.get_texts()]
    scene = runs["1 m/s"].scene.replace(p=1.0)
    quiet = fj.simulate(scene, 0.6, 1e-3)
    assert plot.response(quiet).axes[0].get_legend() is None


def test_a_status_of_one_row_is_shaded_for_as_long_as_a_row_lasts():
    """A stick shorter than the distance of rows is seen, and shading ends where the next status begins."""
    t, still = np.arange(6.0), np.zeros((6, 3))
    scene = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.1), 3.0)
    run = fj.Trajectory(t, still, still, still, np.array([1, 0, 1, 2, 2, 1]), t, t, t, scene)
    axes = Figure().add_subplot()
    handles = plot.shade_status(axes, run)
    assert [handle.get_label() for handle in handles] == ["sticking", "detached"]
    spans = [path.get_extents() for bars in axes.collections for path in bars.get_paths()]
    assert [(span.x0, span.x1) for span in spans] == [(1, 2), (3, 5)]


def test_the_critical_curve_marks_where_islands_were_seen(tmp_path):
    """Fig. 10: filled where the crossing is the only one, hollow elsewhere."""
    scene = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.05), 3.0, fj.Pulse(100.0, 1.2))
    found = fj.critical_perturbation(
        scene, mu=[0.15, 0.2], p_range=(1.0, 3.0), p_step=0.25, tolerance=1e-2, progress=False
    )
    found["only_crossing"][0] = False
    figure = plot.critical(found)
    assert [text.get_text() for text in figure.axes[0].get_legend().get_texts()] == [
        "only crossing seen",
        "islands seen above",
    ]
    drawn(figure, tmp_path)


def test_wrong_shapes_are_refused(a_map):
    """A map with one axis has no picture; the sentence says what to do."""
    with pytest.raises(ValueError, match="two axes"):
        plot.bistability(a_map.isel(mu=0, drop=True))
    with pytest.raises(ValueError, match="quantity"):
        plot.response(next(iter([fj.simulate(fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.1)), 0.01, 1e-3)])), "speed")


def test_pictures_leave_pyplot_alone():
    """Importing fivjax must not import pyplot, whose state is global."""
    import subprocess

    code = "import sys, fivjax, fivjax.plot; sys.exit('matplotlib.pyplot' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], timeout=120).returncode == 0


def test_amplitudes_reach_the_colour_scale(a_map):
    """The colour of a cell is its amplitude: the mesh holds the dataset's values."""
    figure = plot.bistability(a_map)
    meshes = [c for c in figure.axes[0].collections if c.get_array() is not None]
    values = np.ma.compressed(meshes[1].get_array())
    expected = a_map["amplitude"].values[a_map["verdict"].values == 1]
    np.testing.assert_allclose(np.sort(values), np.sort(expected))
