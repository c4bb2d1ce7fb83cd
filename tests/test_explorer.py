"""The explorer without a browser: what sliders do, that nothing is compiled again, what is refused."""

import io
import sys

import jax
import numpy as np
import pytest
import xarray as xr
from PIL import Image

import fivjax as fj
from fivjax.io.datasets import labelled


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


@pytest.fixture(scope="module")
def explorer(scene, a_map):
    return fj.explorer(scene, a_map, t1=0.4)


def pixels(picture) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(picture.png)), int)


def test_a_moved_slider_changes_the_picture_and_compiles_nothing(explorer):
    """Moving any slider draws a new picture from code that is compiled already."""
    compiled = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda event, duration, **about: compiled.append(event) if event.endswith("backend_compile_duration") else None
    )
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
    assert compiled == []


def test_the_scene_itself_lies_on_the_steps_of_its_sliders(explorer, scene):
    """A browser rounds a value to the nearest step from the lower end: at the scene's own it must have nothing to round."""
    for name, slider in explorer.sliders.items():
        steps = (float(scene.parameters[name]) - slider.min) / slider.step
        assert steps == pytest.approx(round(steps), abs=1e-6), name


def test_what_is_said_is_of_the_scene_shown(explorer, scene):
    """The critical friction beside the sliders is that of the structure they describe."""
    explorer.sliders["k1"].value = 97e3
    limit = float(fj.cea.critical_friction(scene.replace(k1=97e3).structure))
    assert f"μ_crit = {limit:.4f}" in explorer.said.value
    explorer.sliders["k1"].value = 100e3
    assert "μ_crit = 0.2282" in explorer.said.value


def test_a_click_opens_the_nearest_lane_exactly(explorer):
    """A place on the map's picture becomes the nearest lane, exactly, also where a slider's steps pass it by."""
    axes = explorer._map_axes
    width, height = axes.figure.canvas.get_width_height()
    x, y = axes.transData.transform((0.155, 1.65))
    unmarked = pixels(explorer.map)
    # The map is of the scene it was made for, so a lane of it has that scene's springs.
    explorer.sliders["k1"].value = 97e3
    explorer.map.clicked = [x / width, 1 - y / height]
    assert (explorer.sliders["mu"].value, explorer.sliders["p"].value) == (0.1511, 1.7)
    assert explorer.sliders["k1"].value == 100e3
    assert np.any(pixels(explorer.map) != unmarked)
    # What a browser makes of it; then a step of the user's own.
    explorer.sliders["mu"].value = 0.151
    assert explorer._value("mu") == 0.1511
    explorer.sliders["mu"].value = 0.152
    assert explorer._value("mu") == 0.152
    explorer.sliders["mu"].value, explorer.sliders["p"].value = 0.2, 1.3


def test_what_the_scene_refuses_is_said(explorer):
    """No picture of an impossible scene: a sentence, and the last picture stays."""
    before = explorer.picture.png
    slider = explorer.sliders["belt_speed"]
    slider.min, old = 0.0, slider.value
    slider.value = 0.0
    assert "must not be zero" in explorer.said.value
    assert explorer.picture.png == before
    slider.value = old


def test_missing_widgets_are_named(scene, monkeypatch):
    monkeypatch.setitem(sys.modules, "ipywidgets", None)
    with pytest.raises(ImportError, match=r"needs ipywidgets.*fivjax\[notebook\]"):
        fj.explorer(scene)


def test_wrong_arguments_are_refused(scene, a_map):
    with pytest.raises(ValueError, match="must name parameters of the scene"):
        fj.explorer(scene, ranges={"stiffness": (0, 1)})
    with pytest.raises(ValueError, match="two axes"):
        fj.explorer(scene, a_map.isel(mu=0, drop=True))
    with pytest.raises(TypeError, match="a map"):
        fj.explorer(scene, 3)
