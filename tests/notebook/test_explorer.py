"""The explorer without a browser: what sliders do, that nothing is compiled again, what is refused."""

import inspect
import io
import sys

import numpy as np
import pytest
import xarray as xr
from PIL import Image

import fivjax as fj
from fivjax.io.datasets import labelled
from fivjax.notebook import sliders
from fivjax.notebook.map_picture import stale
from fivjax.notebook.panels import limits


@pytest.fixture(scope="module")
def scene():
    return fj.Scene(fj.belt_oscillator(), fj.Coulomb(mu=0.2), belt_speed=3.0, load=fj.Pulse(force=100.0, p=1.3))


@pytest.fixture(scope="module")
def a_map(scene):
    """A map made by hand: what it holds does not matter here, only its grid."""
    mu, p = np.array([0.1, 0.1511, 0.22]), np.array([1.0, 1.3, 1.7, 2.0])
    verdict = (mu[:, None] * p > 0.25).astype(np.int8)
    fields = {"verdict": (("mu", "p"), verdict), "amplitude": (("mu", "p"), 3.0 * verdict)}
    return labelled(xr.Dataset(fields, {"mu": mu, "p": p}), scene)


@pytest.fixture(scope="module", autouse=True)
def quick_verdicts():
    """A stand-in for what computes verdicts: undecided at once. Compiling the true one would take a quarter of a minute."""

    def undecided(scene, *, t_max=20.0, progress=None, **axes):
        shape = tuple(map(len, axes.values()))
        fields = {
            "verdict": np.full(shape, -1, np.int8),
            "amplitude": np.zeros(shape),
            "decided_at": np.full(shape, t_max),
        }
        return labelled(xr.Dataset({name: (tuple(axes), x) for name, x in fields.items()}, axes), scene, t_max=t_max)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("fivjax.notebook.explore.bistability_map", undecided)
        yield


@pytest.fixture(scope="module")
def explorer(scene, a_map):
    return fj.explorer(scene, a_map, t1=0.4)


def pixels(picture) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(picture.png)), int)


def test_a_moved_slider_changes_the_picture_and_compiles_nothing(explorer, compilations):
    """Moving any slider draws a new picture from code that is compiled already."""
    before = pixels(explorer.picture)
    explorer.update()
    np.testing.assert_array_equal(pixels(explorer.picture), before)
    moves = {"mu": 0.22, "p": 1.5, "belt_speed": 0.5, "k1": 99e3, "m2": 0.05, "c1": 1.2, "theta": 0.012}
    for name, value in moves.items():
        old = explorer.sliders[name].value
        explorer.sliders[name].value = value
        assert np.mean(pixels(explorer.picture) != before) > 1e-3, name
        explorer.sliders[name].value = old
        np.testing.assert_array_equal(pixels(explorer.picture), before)
    assert compilations == []


def test_the_scene_itself_lies_on_the_steps_of_its_sliders(explorer, scene):
    """A browser rounds a value to the nearest step from the lower end: at the scene's own it must have nothing to round."""
    for name, slider in explorer.sliders.items():
        steps = (float(scene.parameters[name]) - slider.min) / slider.step
        assert steps == pytest.approx(round(steps), abs=1e-6), name


def test_sliders_of_negative_values_reach_beyond_them():
    widgets = pytest.importorskip("ipywidgets")
    for name, value, reached in (("belt_speed", -1.0, (-10.0, -0.1)), ("theta", -0.02, (-0.03, -0.01))):
        made = sliders.slider(widgets, name, value, {}, {})
        assert made.min == pytest.approx(reached[0], rel=0.02) and made.max == pytest.approx(reached[1])


def test_a_range_may_be_an_array():
    made = sliders.slider(pytest.importorskip("ipywidgets"), "mu", 0.2, {"mu": np.array([0.1, 0.4])}, {})
    assert made.min == pytest.approx(0.1) and made.max == pytest.approx(0.4)


def test_what_is_said_is_of_the_scene_shown(explorer, scene):
    """The critical friction beside the sliders is that of the structure they describe."""
    explorer.sliders["k1"].value = 97e3
    limit = float(fj.cea.critical_friction(scene.replace(k1=97e3).structure))
    assert f"μ_crit = {limit:.4f}" in explorer.said.value
    explorer.sliders["k1"].value = 100e3
    assert "μ_crit = 0.2282" in explorer.said.value


def clicked(explorer, mu: float, p: float) -> None:
    """A click on the map's picture at this place."""
    axes = explorer._map.axes
    width, height = axes.figure.canvas.get_width_height()
    x, y = axes.transData.transform((mu, p))
    explorer.map.clicked = [x / width, 1 - y / height]


def test_a_click_opens_the_nearest_trajectory_exactly(explorer):
    """A place on the map's picture becomes the nearest trajectory, exactly, also where a slider's steps pass it by."""
    unmarked = pixels(explorer.map)
    # The map is of the scene it was made for, so a trajectory of it has that scene's springs.
    explorer.sliders["k1"].value = 97e3
    clicked(explorer, 0.155, 1.65)
    assert (explorer.sliders["mu"].value, explorer.sliders["p"].value) == (0.1511, 1.7)
    assert explorer.sliders["k1"].value == 100e3
    assert np.any(pixels(explorer.map) != unmarked)
    # What a browser makes of it; then a step of the user's own.
    explorer.sliders["mu"].value = 0.151
    assert explorer._value("mu") == 0.1511
    explorer.sliders["mu"].value = 0.152
    assert explorer._value("mu") == 0.152
    explorer.sliders["mu"].value, explorer.sliders["p"].value = 0.2, 1.3


def test_a_click_beside_the_map_opens_nothing(explorer):
    """A click on the margin, the legend or the colour bar once opened the trajectory of the nearest corner."""
    before = {name: slider.value for name, slider in explorer.sliders.items()}
    for place in ([0.01, 0.99], [0.99, 0.5], [0.5, 0.999]):
        explorer.map.clicked = place
        assert {name: slider.value for name, slider in explorer.sliders.items()} == before


def test_the_verdict_of_what_is_shown_is_shown(explorer):
    """On the map it is the map's own, at once; elsewhere it is computed, and never the nearest cell's."""
    clicked(explorer, 0.22, 1.0)
    assert "verdict: sliding" in explorer.said.value
    clicked(explorer, 0.22, 2.0)
    assert "verdict: limit cycle" in explorer.said.value
    explorer.sliders["mu"].value = 0.2
    explorer.wait()
    assert "verdict: undecided" in explorer.said.value
    explorer.sliders["p"].value = 1.3


def test_a_map_of_another_structure_is_veiled_and_computed_anew(explorer, a_map):
    """With k1 = 103 000 the map still showed the old structure's verdicts beside the new one's trajectory."""
    whole = pixels(explorer.map)
    assert explorer.anew.layout.display == "none"
    explorer.sliders["k1"].value = 103e3
    assert stale(explorer._map.differences(explorer._shown)) == ("This map is of k1 = 100000;\nshown is k1 = 103000.")
    assert explorer.anew.layout.display == ""
    assert pixels(explorer.map).mean() > whole.mean() + 1
    explorer.wait()
    assert "verdict: undecided" in explorer.said.value
    explorer.anew.click()
    assert explorer.anew.layout.display == "none" and not explorer.anew.disabled
    assert float(explorer._map.scene.parameters["k1"]) == 103e3
    # Back at the old structure it is the new map that is of another one.
    explorer.sliders["k1"].value = 100e3
    assert explorer.anew.layout.display == ""
    explorer.anew.click()
    assert explorer.anew.layout.display == "none"


def test_a_map_given_for_another_scene_is_veiled_from_the_start(scene, a_map):
    found = fj.explorer(scene.replace(k1=103e3), a_map, t1=0.4)
    assert found.anew.layout.display == ""


@pytest.mark.slow
def test_the_verdict_agrees_with_the_contact_events(scene, monkeypatch):
    """The map's own engine: a soft kick dies out, and with k1 = 103 000 a hard one does not."""
    monkeypatch.setattr("fivjax.notebook.explore.bistability_map", fj.bistability_map)
    found = fj.explorer(scene, t1=0.4)
    for changes, verdict in (({"p": 1.0}, "sliding"), ({"k1": 103e3, "p": 2.0}, "limit cycle")):
        for name, value in changes.items():
            found.sliders[name].value = value
        found.wait()
        assert f"verdict: {verdict}" in found.said.value
        assert ("<br>0 contact events" in found.said.value) == (verdict == "sliding")


def test_rounding_is_not_drawn_as_motion(explorer):
    """At p = 1 nothing moves: the panels showed rounding, 1e-12 m/s², with what the numbers have in common over a label."""
    assert limits(1e-12 * np.sin(np.arange(9.0)), 0.1) == pytest.approx((-0.05, 0.05))
    assert limits([0.0, 2.0], 0.1) == pytest.approx((-0.1, 2.1))
    assert limits([np.nan, np.nan], 0.1) == pytest.approx((-0.05, 0.05))
    explorer.sliders["p"].value = 1.0
    figure = inspect.getclosurevars(explorer._panels).nonlocals["canvas"].figure
    wave, _, _, orbit = (axes.lines[0] for axes in figure.axes)
    for line in (wave, orbit):
        axes = line.axes
        assert np.ptp(line.get_ydata()) < 1e-3 * np.ptp(axes.get_ylim())
        assert axes.xaxis.get_offset_text().get_text() == ""
        assert "+" not in axes.yaxis.get_offset_text().get_text()
        assert max(len(label.get_text()) for label in axes.get_yticklabels()) <= 6
    assert np.ptp(orbit.get_xdata()) < 1e-3 * np.ptp(orbit.axes.get_xlim())
    explorer.sliders["p"].value = 1.3


def test_sliders_keep_their_width(explorer):
    """In a window of 900 pixels they shrank to stubs: now the picture moves below them."""
    beside = explorer.widget.children[0]
    assert beside.layout.flex_flow == "row wrap"
    for slider in explorer.sliders.values():
        assert slider.layout.min_width == slider.layout.width and slider.layout.flex == "0 0 auto"


def test_what_the_scene_refuses_is_said(explorer):
    """No picture of an impossible scene: a sentence, and the last picture stays, also when the verdict of the last values comes."""
    slider = explorer.sliders["belt_speed"]
    slider.min, old = 0.0, slider.value
    slider.value = old + 2 * slider.step
    before = explorer.picture.png
    slider.value = 0.0
    explorer.wait()
    assert "must not be zero" in explorer.said.value
    assert explorer.picture.png == before
    slider.value = old


def test_missing_widgets_are_named(scene, monkeypatch):
    monkeypatch.setitem(sys.modules, "ipywidgets", None)
    with pytest.raises(
        ImportError, match=r"needs ipywidgets.*`pip install ipywidgets anywidget`.*`pip install \"\.\[notebook\]\"`"
    ):
        fj.explorer(scene)


def test_wrong_arguments_are_refused(scene, a_map):
    with pytest.raises(ValueError, match="must name parameters of the scene"):
        fj.explorer(scene, ranges={"stiffness": (0, 1)})
    with pytest.raises(TypeError, match="`ranges` must be a dictionary"):
        fj.explorer(scene, ranges=0.3)
    for pair in (0.3, (0.4, 0.1)):
        with pytest.raises(ValueError, match="the two ends of each slider, the lower one first, but `mu` has"):
            fj.explorer(scene, ranges={"mu": pair})
    with pytest.raises(ValueError, match="it has no `verdict`"):
        fj.explorer(scene, a_map.drop_vars("verdict"))
    with pytest.raises(ValueError, match="map over parameters of the scene, but `x2` is none"):
        fj.explorer(scene, a_map.rename(mu="x2"))
    with pytest.raises(ValueError, match="two axes"):
        fj.explorer(scene, a_map.isel(mu=0, drop=True))
    with pytest.raises(TypeError, match="a map"):
        fj.explorer(scene, 3)
