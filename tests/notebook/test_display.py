"""How results show themselves: tables and pictures in a notebook, `fj.show`, and what a dataset offers as `m.fivjax`."""

import numpy as np
import pytest
import xarray as xr
from matplotlib.figure import Figure

import fivjax as fj
from fivjax.io.datasets import labelled
from fivjax.notebook import display, registration
from tests.helpers.refusing import refused


@pytest.fixture(scope="module")
def scene():
    return fj.Scene(fj.belt_oscillator(), fj.Coulomb(mu=0.2), belt_speed=3.0, load=fj.Pulse(force=100.0, p=1.3))


@pytest.fixture(scope="module")
def run(scene):
    return fj.simulate(scene, 0.4, 1 / 150, energy=True)


@pytest.fixture(scope="module")
def a_map(scene):
    """A map made by hand: what it holds does not matter here, only its axes."""
    axes = {"mu": [0.1, 0.15, 0.22], "p": [1.0, 1.3, 1.7, 2.0], "k1": [1e5, 1.1e5]}
    verdict = (np.array(axes["mu"])[:, None, None] * np.array(axes["p"])[:, None] * np.ones(2) > 0.25).astype(np.int8)
    fields = {name: (tuple(axes), values) for name, values in {"verdict": verdict, "amplitude": 3.0 * verdict}.items()}
    fields["p_crit"] = (("mu", "k1"), np.full((3, 2), 1.5))
    return labelled(xr.Dataset(fields, axes), scene)


def test_a_scene_shows_its_parameters_with_units(scene):
    table = scene._repr_html_()
    for name, value, unit in (("k1", "100000", "N/m"), ("belt_speed", "3", "m/s"), ("mu", "0.2", "")):
        row = next(row for row in table.split("<tr>") if f">{name}<" in row)
        assert f">{value}<" in row
        assert f">{unit}<" in row


def test_datasets_show_as_xarray_shows_them(a_map):
    """Maps were once recognised by the names of their variables, and everyone's datasets went through fivjax."""
    assert "data:image" not in a_map._repr_html_()
    for dataset in (a_map.isel(k1=0), xr.open_dataset):
        assert registration.SHOWN_BY.get((type(dataset).__module__, type(dataset).__name__)) is None


def test_a_dataset_offers_its_picture_and_its_scene(a_map, scene):
    """`m.fivjax` is what a dataset has of fivjax: it draws and knows its scene."""
    flat = a_map.isel(k1=0)
    assert isinstance(flat.fivjax.plot(), Figure) and isinstance(flat.fivjax.show(), Figure)
    assert str(flat.fivjax.scene) == str(scene)
    assert isinstance(flat.fivjax.plot(value="verdict"), Figure)


def test_show_draws_what_has_a_picture(run, tmp_path):
    """Trajectories, also saved ones, have a picture; what fivjax did not make is refused."""
    assert isinstance(fj.show(run), Figure)
    own = Figure()
    assert fj.show(run, figure=own) is own and len(own.axes) == 2
    fj.save(run, tmp_path / "run.nc")
    assert isinstance(fj.show(fj.open(tmp_path / "run.nc")), Figure)
    with refused(
        TypeError, "Argument `quantities` is no option", "`response` of `fj.plot`", "Did you mean `quantity`?"
    ):
        fj.show(run, quantities="velocity")
    with refused(TypeError, "can draw"):
        fj.show(xr.Dataset({"verdict": (("mu", "p"), np.zeros((2, 2)))}))


def test_modes_at_one_value_are_points(scene):
    """They were said to have no picture, although the function that draws them draws points."""
    drawn = fj.show(fj.cea.modes(scene.structure, mu=[0.2], progress=False))
    assert {line.get_marker() for line in drawn.axes[0].lines[:2]} == {"o"}


def test_the_remedy_for_three_axes_works(a_map):
    """The remedy once named an axis that the map did not have."""
    assert isinstance(fj.show(a_map.isel(mu=0, k1=0)), Figure)
    with refused(ValueError, "2 axes, but it has 3: mu, p, k1", "`fj.show(m.isel(k1=0))`"):
        fj.show(a_map)
    assert isinstance(eval("fj.show(m.isel(k1=0))", {"fj": fj, "m": a_map}), Figure)


def test_what_ipython_is_told_exists():
    """Classes and functions are told by name; a class that moves must be told anew."""
    public = {fj.Trajectory, fj.Calibration, fj.cea.Sensitivity}
    assert {(kind.__module__, kind.__name__) for kind in public} == set(registration.SHOWN_BY)
    for function in registration.SHOWN_BY.values():
        assert callable(getattr(display, function))


def test_results_show_in_a_running_ipython(scene, run, a_map, monkeypatch):
    """A running IPython shows results as pictures; without one nothing happens, and pyplot keeps its own figures."""
    from IPython.core.interactiveshell import InteractiveShell

    monkeypatch.setattr("IPython.get_ipython", lambda: None)
    assert not registration.register()
    shell = InteractiveShell()
    monkeypatch.setattr("IPython.get_ipython", lambda: shell)
    assert registration.register()
    shown = {name: shell.display_formatter.format(result)[0] for name, result in {"run": run, "scene": scene}.items()}
    assert "belt inclination" in shown["scene"]["text/html"]
    assert "data:image/png;base64," in shown["run"]["text/html"] and "energy residual" in shown["run"]["text/html"]
    assert "data:image" not in shell.display_formatter.format(a_map)[0]["text/html"]
    figure = Figure()
    assert shell.display_formatter.format(figure)[0]["image/png"]
    figure.canvas.manager = object()
    assert "image/png" not in shell.display_formatter.format(figure)[0]


def test_a_boundary_has_a_picture_of_its_own_although_it_has_verdicts():
    boundary = xr.Dataset({name: ("a", np.zeros(2)) for name in ("verdict", "manifold", "path")})
    drawing = next(draw for is_one, draw in display._PICTURES if is_one(boundary))
    assert drawing is fj.plot.boundary_section
