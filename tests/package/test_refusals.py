"""Bad input at the public functions, the files and the command line: a sentence, at once, and nothing written.

No test here may reach an engine: the fixture below makes that an error of its own kind.
"""

import inspect
import math
import re
import sys

import diffrax
import jax
import numpy as np
import pytest
import xarray as xr
from matplotlib.figure import Figure

import fivjax as fj
from fivjax import cli
from fivjax.foundation import arguments, digits
from fivjax.io import files
from fivjax.linear.design import lower_growth_rate
from fivjax.model.own_structures import ARGUMENTS
from tests.helpers.refusing import EngineReached, refused, refused_on_the_command_line, untouched, without_engines


@pytest.fixture(autouse=True)
def no_engine(monkeypatch):
    """Makes it an error to reach an engine: bad input is refused before a minute of compiling, not after it."""
    without_engines(monkeypatch)


@pytest.fixture
def constant_scene():
    return fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.2), 3.0, fj.ConstantLoad())


def test_the_engine_is_reached_by_good_input(paper_scene, tmp_path):
    """Good input reaches the stand-ins for the engines; if it did not, the tests below would prove nothing."""
    for call in (
        lambda: fj.simulate(paper_scene, 0.1, 1e-3),
        lambda: fj.bistability_map(paper_scene, mu=[0.1, 0.2]),
        lambda: fj.critical_perturbation(paper_scene),
        lambda: cli.main(["map", "--out", str(tmp_path / "never-written")]),
        lambda: cli.main(["simulate", "--out", str(tmp_path / "never-written")]),
    ):
        with pytest.raises(EngineReached):
            call()


def test_refusals_compile_nothing(paper_scene, compilations):
    """Bad input is refused at once: not even a sum is compiled, let alone a stepper."""
    with pytest.raises(ValueError, match="increasing"):
        fj.bistability_map(paper_scene, mu=[0.2, 0.1])
    with pytest.raises(ValueError, match="t1"):
        fj.simulate(paper_scene, -1.0)
    assert compilations == []


# --------------------------------------------------------------------------------------------- axes

AXES = [
    ([], ValueError, ["empty"]),
    ([0.2, 0.1], ValueError, ["strictly increasing", "from 0.2 to 0.1"]),
    ([0.1, 0.2, 0.2], ValueError, ["strictly increasing", "from 0.2 to 0.2", "values 1 and 2"]),
    ([0.1, math.nan], ValueError, ["finite", "nan"]),
    ([0.1, math.inf], ValueError, ["finite", "inf"]),
    ([[0.1, 0.2]], ValueError, ["one-dimensional", "(1, 2)"]),
    ("0.1", TypeError, ["numeric", "'0.1' (str)"]),
    (["a", "b"], TypeError, ["numeric"]),
    ([0.1, 0.2j], TypeError, ["numeric"]),
    ([[0.1], [0.1, 0.2]], TypeError, ["numeric"]),
    ([False, True], TypeError, ["numeric"]),
    (None, TypeError, ["numeric", "None"]),
    ({0.1, 0.2}, TypeError, ["numeric", "set"]),
    ([0.1, None], TypeError, ["numeric", "holds None"]),
    (np.array([0.1, "b"], object), TypeError, ["numeric", "holds 'b'"]),
    (np.ma.array([0.1, 0.15, 0.2], mask=[0, 1, 0]), ValueError, ["masked"]),
]
BOTH = [fj.bistability_map, fj.critical_perturbation]


@pytest.mark.parametrize("function", BOTH, ids=lambda f: f.__name__)
@pytest.mark.parametrize(("values", "error", "fragments"), AXES, ids=[str(axis[0]) for axis in AXES])
def test_bad_axes(paper_scene, function, values, error, fragments):
    """An axis that is empty, not increasing, not finite or not numeric is refused: its map would mean nothing."""
    with refused(error, "`mu`", *fragments):
        function(paper_scene, mu=values)


@pytest.mark.parametrize("function", BOTH, ids=lambda f: f.__name__)
@pytest.mark.parametrize("name", ["mu_crit", "t_maxx", "impact_law", "mu_static"])
def test_unknown_axes(paper_scene, function, name):
    """An unknown name is refused: ignored, a misspelt option would change nothing unnoticed."""
    with refused(ValueError, f"`{name}`", "belt_speed", "theta"):
        function(paper_scene, **{name: [0.1, 0.2]})


@pytest.mark.parametrize("function", BOTH, ids=lambda f: f.__name__)
@pytest.mark.parametrize(
    ("axis", "fragments"),
    [
        (dict(mu=[-0.1, 0.2]), ("`mu`", "non-negative", "-0.1")),
        (dict(m1=[0.0, 1.0]), ("`m1`", "positive", "0")),
        (dict(restitution=[0.5, 1.5]), ("`restitution`", "at most 1", "1.5")),
        (dict(mu=[0.1, 0.2], k2=[-1.0, 1e5]), ("`k2`", "non-negative", "-1")),
    ],
)
def test_axis_values_that_the_scene_refuses(paper_scene, function, axis, fragments):
    """Every value of an axis must be one that the scene accepts: a verdict outside the model means nothing."""
    with refused(ValueError, *fragments):
        function(paper_scene, **axis)


def test_axes_that_cross_each_other():
    """Axes are refused if at any point of the map static friction falls below sliding friction."""
    scene = fj.Scene(fj.belt_oscillator(), fj.ExponentialDecay(0.3, 0.1), 3.0, fj.Pulse())
    with refused(ValueError, "`mu_static`", "`mu_dynamic`", "0.1", "0.2"):
        fj.bistability_map(scene, mu_static=[0.1, 0.3], mu_dynamic=[0.05, 0.2])


def test_a_p_axis_needs_a_pulse(constant_scene):
    """An axis p is refused for a constant load, which has no kick: all rows of the map would be the same."""
    with refused(ValueError, "`p`", "Pulse"):
        fj.bistability_map(constant_scene, p=[1.0, 1.5])
    with refused(TypeError, "`scene.load`", "Pulse", "ConstantLoad"):
        fj.critical_perturbation(constant_scene, mu=[0.1, 0.2])


def test_a_map_needs_an_axis(paper_scene):
    """A map without an axis is refused, with the names of the parameters that can be one."""
    with refused(ValueError, "at least one axis", "mu", "belt_speed"):
        fj.bistability_map(paper_scene)


def test_p_is_not_an_axis_where_it_is_sought(paper_scene):
    """`p` is refused as an axis where the critical p is sought: the search sets it."""
    with refused(ValueError, "`p`", "`p_range`"):
        fj.critical_perturbation(paper_scene, p=[1.0, 2.0])


# ------------------------------------------------------------------------------------------- options


@pytest.mark.parametrize("function", BOTH, ids=lambda f: f.__name__)
@pytest.mark.parametrize(
    ("options", "error", "fragments"),
    [
        (dict(t_max=0.0), ValueError, ["`t_max`", "positive", "0"]),
        (dict(t_max=-3.0), ValueError, ["`t_max`", "positive", "-3"]),
        (dict(t_max=math.inf), ValueError, ["`t_max`", "finite", "inf"]),
        (dict(t_max="20"), TypeError, ["`t_max`", "numeric", "'20'"]),
        (dict(t_max=[1.0, 2.0]), ValueError, ["`t_max`", "one number", "(2,)"]),
        (dict(memory=0), ValueError, ["`memory`", "positive", "0"]),
        (dict(memory=math.nan), ValueError, ["`memory`", "finite", "nan"]),
        (dict(method="event-exact"), TypeError, ["`method`", "EventExact()", "'event-exact'"]),
        (dict(method=diffrax.Tsit5()), TypeError, ["`method`", "EventExact()", "Tsit5"]),
        (dict(method=fj.EventExact), TypeError, ["`method`", "EventExact()"]),
    ],
)
def test_bad_options(paper_scene, function, options, error, fragments):
    """Durations and memory must be positive and finite, and a method one of this package: others cannot run a map."""
    with refused(error, *fragments):
        function(paper_scene, mu=[0.1, 0.2], **options)


@pytest.mark.parametrize(
    ("options", "error", "fragments"),
    [
        (dict(max_steps=0), ValueError, ["`max_steps`", "at least 1", "0"]),
        (dict(max_steps=1e6), ValueError, ["`max_steps`", "whole number", "1000000.0"]),
        (dict(max_steps=True), ValueError, ["`max_steps`", "True"]),
        (dict(resume=7), TypeError, ["`resume`", "path", "7"]),
        (dict(resume="missing/map.part"), ValueError, ["`missing`", "does not exist"]),
        (dict(resume="."), ValueError, ["`.`", "is a folder"]),
    ],
)
def test_bad_options_of_a_long_map(paper_scene, options, error, fragments):
    """A map with no steps, or with nowhere to keep its checkpoints, is refused before it starts."""
    with refused(error, *fragments):
        fj.bistability_map(paper_scene, mu=[0.1, 0.2], **options)


@pytest.mark.parametrize("function", [*BOTH, fj.simulate], ids=lambda f: f.__name__)
@pytest.mark.parametrize("scene", [None, "scene", fj.belt_oscillator()], ids=["None", "str", "Structure"])
def test_what_is_no_scene(function, scene):
    """What is no scene is refused as such, not by an attribute that it lacks."""
    with refused(TypeError, "`scene`", "a Scene"):
        function(scene)


@pytest.mark.parametrize(
    ("options", "error", "fragments"),
    [
        (dict(p_range=(2.0, 1.0)), ValueError, ["p_range[1]", "above 2", "1"]),
        (dict(p_range=(1.0, 1.0)), ValueError, ["p_range[1]", "above 1", "1"]),
        (dict(p_range=(-1.0, 1.0)), ValueError, ["p_range[0]", "non-negative", "-1"]),
        (dict(p_range=(math.nan, 1.0)), ValueError, ["p_range[0]", "finite", "nan"]),
        (dict(p_range=(1.0, math.inf)), ValueError, ["p_range[1]", "finite", "inf"]),
        (dict(p_range=("a", "b")), TypeError, ["p_range[0]", "numeric", "'a'"]),
        (dict(p_step=0.0), ValueError, ["`p_step`", "positive", "0"]),
        (dict(p_step=-0.1), ValueError, ["`p_step`", "positive", "-0.1"]),
        (dict(tolerance=0.0), ValueError, ["`tolerance`", "positive", "0"]),
        (dict(tolerance=None), TypeError, ["`tolerance`", "numeric", "None"]),
        (dict(p_range=3.0), ValueError, ["p_range", "3"]),
        (dict(p_range=(1.0, 2.0, 3.0)), ValueError, ["p_range", "3"]),
        (dict(p_range=(1.0, 1.2), p_step=1.0), ValueError, ["`p_step`", "1"]),
    ],
)  # fmt: skip
def test_bad_search_ranges(paper_scene, options, error, fragments):
    """A search for the critical p needs a range that goes up and positive steps: else it would be empty or endless."""
    with refused(error, *fragments):
        fj.critical_perturbation(paper_scene, **options)


# ------------------------------------------------------------------------------------------- methods


@pytest.mark.parametrize(
    ("make", "error", "fragments"),
    [
        (lambda: fj.EventExact(order=3), ValueError, ["`order`", "at least 4", "3"]),
        (lambda: fj.EventExact(order=8.5), ValueError, ["`order`", "8.5"]),
        (lambda: fj.EventExact(order="16"), ValueError, ["`order`", "'16'"]),
        (lambda: fj.EventExact(order=True), ValueError, ["`order`", "True"]),
        (lambda: fj.EventExact(tolerance=0.0), ValueError, ["`tolerance`", "positive", "0"]),
        (lambda: fj.EventExact(tolerance=-1e-9), ValueError, ["`tolerance`", "positive", "-1e-09"]),
        (lambda: fj.EventExact(tolerance="small"), TypeError, ["`tolerance`", "'small'"]),
        (lambda: fj.EventExact(dt=0.0), ValueError, ["`dt`", "positive", "0"]),
        (lambda: fj.EventExact(dt=math.nan), ValueError, ["`dt`", "finite", "nan"]),
        (lambda: fj.EventExact(dt=None), TypeError, ["`dt`", "None"]),
        (lambda: fj.WhereSwitched(dt=0.0), ValueError, ["`dt`", "positive", "0"]),
        (lambda: fj.WhereSwitched(dt=-1e-5), ValueError, ["`dt`", "positive", "-1e-05"]),
        (lambda: fj.WhereSwitched(dt=math.inf), ValueError, ["`dt`", "finite", "inf"]),
        (lambda: fj.WhereSwitched(dt="fast"), TypeError, ["`dt`", "'fast'"]),
        (lambda: fj.WhereSwitched("Tsit5"), TypeError, ["`solver`", "diffrax.Tsit5()", "'Tsit5'"]),
        (lambda: fj.WhereSwitched(diffrax.Tsit5), TypeError, ["`solver`", "diffrax.Tsit5()"]),
        (lambda: fj.WhereSwitched(diffrax.Kvaerno5()), TypeError, ["`solver`", "explicit", "Kvaerno5"]),
        (lambda: fj.WhereSwitched(fj.EventExact()), TypeError, ["`solver`", "explicit", "EventExact"]),
        (lambda: fj.EventExact(dt=np.array([1.0, 2.0])), ValueError, ["`dt`", "(2,)"]),
    ],
)  # fmt: skip
def test_bad_methods(make, error, fragments):
    """Orders, tolerances, steps and solvers that a method cannot work with are refused: a run might never end."""
    with refused(error, *fragments):
        make()


def test_an_order_counted_by_numpy_is_a_whole_number():
    """A NumPy integer is a whole number and accepted as an order."""
    assert fj.EventExact(order=np.int64(12)).order(None) == 12


# ------------------------------------------------------------------------------------------ simulate


@pytest.mark.parametrize("name", ["t1", "dt_save"])
@pytest.mark.parametrize(
    ("value", "error", "fragments"),
    [
        (0.0, ValueError, ["positive", "0"]),
        (-2.0, ValueError, ["positive", "-2"]),
        (math.nan, ValueError, ["finite", "nan"]),
        (math.inf, ValueError, ["finite", "inf"]),
        ("2", TypeError, ["numeric", "'2' (str)"]),
        (None, TypeError, ["numeric", "None"]),
        (2j, TypeError, ["2j (complex)"]),
        (True, TypeError, ["True (bool)"]),
        ([1.0, 2.0], ValueError, ["one number", "(2,)"]),
    ],
)
def test_bad_times(paper_scene, name, value, error, fragments):
    """The end and the saving interval must be positive, finite numbers, or there are no rows or endlessly many."""
    with refused(error, f"`{name}`", *fragments):
        fj.simulate(paper_scene, **{name: value})


ON_BELT = np.zeros(6)


@pytest.mark.parametrize(
    ("y0", "error", "fragments"),
    [
        (np.zeros(5), ValueError, ["3 displacements", "(5,)"]),
        (np.zeros((2, 3)), ValueError, ["3 displacements", "(2, 3)"]),
        ((np.zeros(3), np.zeros(2)), ValueError, ["3 displacements", "(3,) and (2,)"]),
        ([0.0] * 7, ValueError, ["3 displacements", "(7,)"]),
        ([0.0, 0.0, -1e-6, 0.0, 0.0, 0.0], ValueError, ["below the belt", "-1e-06 m"]),
        ((np.array([0.0, 0.0, -0.25]), np.zeros(3)), ValueError, ["below the belt", "-0.25 m"]),
        ([0.0, 0.0, 0.0, 0.0, 0.0, -0.5], ValueError, ["moving into it", "-0.5 m/s"]),
        ([math.nan, 0.0, 0.0, 0.0, 0.0, 0.0], ValueError, ["finite"]),
        ([0.0, 0.0, 0.0, 0.0, math.inf, 0.0], ValueError, ["finite"]),
        *(
            pytest.param(y0, error, fragments, id=reason)
            for y0, error, fragments, reason in (
                ((np.zeros(2), np.zeros(4)), ValueError, ["(2,)", "(4,)"], "a pair is only checked when joined"),
                (0.0, ValueError, ["3 displacements"], "a number is joined before it is checked"),
                ((np.zeros(3), 0.0), ValueError, ["3 displacements"], "a pair with a number is joined before it is checked"),
                ("rest", (TypeError, ValueError), ["'rest'"], "a text reaches JAX"),
                ((None, np.zeros(3)), (TypeError, ValueError), ["None"], "None reaches JAX"),
                (ON_BELT + 0j, TypeError, ["complex"], "complex values lose their imaginary part with a warning"),
            )
        ),
    ],
)  # fmt: skip
def test_bad_starts(paper_scene, y0, error, fragments):
    """A start of the wrong shape or kind, below the belt or moving into it is refused: it is no state of the model."""
    with refused(error, "`y0`", *fragments):
        fj.simulate(paper_scene, 0.01, y0=y0)


@pytest.mark.parametrize(
    "y0",
    [np.zeros(6), [0.0] * 6, [0.0, 1e-3, -1e-31, 0.0, 0.4, -1e-18], (np.zeros(3), np.zeros(3)), ([0.0] * 3, [0.0] * 3)],
)
def test_good_starts(paper_scene, y0):
    """A start may be one vector or a pair, of arrays or lists, so that a run can go on from the end of another."""
    with pytest.raises(EngineReached):
        fj.simulate(paper_scene, 0.01, y0=y0)


def test_scenes_that_cannot_be_simulated(paper_scene):
    """A scene beyond the Painlevé limit, or without a sliding equilibrium to start from, is refused."""
    with refused(ValueError, "Painlevé", "150", "108.5"):
        fj.simulate(paper_scene.replace(mu=150.0))
    with refused(ValueError, "`belt_speed`", "zero", "`y0`"):
        fj.simulate(paper_scene.replace(belt_speed=0.0))
    pulled = fj.Structure(np.eye(2), np.eye(2), np.eye(2), [0.0, 1.0], tangential=0, normal=1)
    with refused(ValueError, "sliding equilibrium", "pull with 100 N"):
        fj.simulate(fj.Scene(pulled, fj.Coulomb(0.2), 1.0))


def test_method_of_simulate(paper_scene):
    """A plain diffrax solver is refused as a method: it knows nothing of the contact."""
    with refused(TypeError, "`method`", "EventExact()", "Dopri5"):
        fj.simulate(paper_scene, method=diffrax.Dopri5())


@pytest.mark.parametrize("name", ["t1", "dt_save"])
def test_times_that_are_traced(paper_scene, name):
    """How many rows there are cannot depend on what JAX traces: a sentence, where JAX would name its own machinery."""
    with refused(TypeError, f"`{name}`", "traced"):
        jax.jvp(lambda x: fj.simulate(paper_scene, **{"t1": 0.1, "dt_save": 0.01, name: x}).t[-1], (0.1,), (1.0,))


# -------------------------------------------------------------------------------------- other kinds of things

STRUCTURES = [fj.painleve_friction, fj.delassus, fj.in_contact_coordinates]


@pytest.mark.parametrize("given", [None, 1.0, "a", [1, 2], {}])
def test_what_is_no_structure_or_scene(given):
    """Named with its kind, where Python would name an attribute that it lacks."""
    for function in STRUCTURES:
        with refused(TypeError, "`structure`", "belt_oscillator()"):
            function(given)
    with refused(TypeError, "`scene`", "a Scene"):
        fj.sliding_equilibrium(given)


@pytest.mark.parametrize("function", STRUCTURES)
def test_several_structures_in_one(function):
    with jax.enable_x64(True):
        several = jax.vmap(lambda k1: fj.belt_oscillator(k1=k1))(np.array([1e5, 2e5]))
    with refused(ValueError, "not one structure but several", "jax.vmap"):
        function(several)


def test_belt_speeds_that_are_no_array():
    with refused(TypeError, "`belt_speed` must be numeric"):
        fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.2), [[1.0], [1.0, 2.0]])


@pytest.mark.parametrize("given", [1.0, "a", [1, 2], {}, True])
def test_what_is_no_cycle(paper_scene, given):
    with refused(TypeError, "`cycle`", "limit_cycle(scene)"):
        fj.saddle_cycle(paper_scene, given)


def test_a_cycle_of_another_structure(paper_scene):
    cycle = fj.limit_cycle(paper_scene.replace(mu=0.2, belt_speed=1.0))
    other = fj.Structure(np.eye(2), np.eye(2), np.eye(2), [0.0, -1.0], 0, 1)
    with refused(ValueError, "`cycle`", "2 displacements"):
        fj.saddle_cycle(fj.Scene(other, fj.Coulomb(0.2), 1.0, fj.ConstantLoad(1.0)), cycle)


def in_names(scene):
    structure, one = scene.structure, lambda run: run.velocity[-1, 0]
    return {
        "wrt": lambda given: fj.derivatives(one, scene, given),
        "over": lambda given: fj.smallest_kick(scene, over=given),
        "free": lambda given: fj.design.raise_critical_perturbation(scene, free=given),
        "coordinates": lambda given: fj.Structure(
            np.eye(3), np.zeros((3, 3)), np.eye(3), [0.0, 0.0, -1.0], coordinates=given
        ),
        "bounds": lambda given: fj.design.lower_growth_rate(structure, given, mu=0.3),
    }


@pytest.mark.parametrize("name", ["wrt", "over", "free", "coordinates"])
@pytest.mark.parametrize("given", [1.0, [1, 2], {"k1": 1.0}, 1j])
def test_what_is_no_list_of_names(paper_scene, name, given):
    with refused(TypeError, f"`{name}`", "list of names"):
        in_names(paper_scene)[name](given)


@pytest.mark.parametrize("given", [1.0, [1, 2], "a", True, 0])
def test_what_is_no_dictionary_of_bounds(paper_scene, given):
    """Zero is no bounds either, although it is as false as none."""
    for call in (
        lambda: fj.design.lower_growth_rate(paper_scene.structure, given, mu=0.3),
        lambda: fj.design.raise_critical_friction(paper_scene.structure, given),
        lambda: fj.design.raise_critical_perturbation(paper_scene, free="k1", bounds=given),
        lambda: fj.smallest_kick(paper_scene, bounds=given),
    ):
        with refused(TypeError, "`bounds`", "a dictionary"):
            call()
    with refused(ValueError, "`bounds['p']`", "two numbers"):
        fj.smallest_kick(paper_scene, bounds={"p": 3.0})


@pytest.mark.parametrize("given", ["a", {}, 1.0, None])
def test_what_are_no_starts(paper_scene, given):
    """By the name of the argument, and before a kick is followed to its end."""
    with refused(TypeError, "`starts`"):
        fj.limit_cycles(paper_scene, starts=given)
    with refused(TypeError, "`starts[0]`", "'a'"):
        fj.limit_cycles(paper_scene, starts=["a"])


@pytest.mark.parametrize("given", [None, 1.0, "a", [1, 2]])
def test_what_no_structure_is_made_of(given):
    """Refused before JAX is given a function that is none."""
    with refused(TypeError, "`matrices_of`", "a function"):
        fj.Structure.from_parameters(given, {"k": 1.0})
    with refused(TypeError, "`parameters`", "a dictionary"):
        fj.Structure.from_parameters(lambda k: None, given)
    with refused(ValueError, "`parameters`", "at least one"):
        fj.Structure.from_parameters(lambda: None, {})
    for name in ARGUMENTS:
        with refused(ValueError, "`parameters`", f"`{name}`", "another name"):
            fj.Structure.from_parameters(lambda **_: None, {name: 1.0})


def test_an_inclination_in_degrees(constant_scene):
    for call in (
        lambda: fj.belt_oscillator(theta=10),
        lambda: constant_scene.replace(theta=-10.0),
        lambda: fj.bistability_map(constant_scene, theta=[0.0, 10.0]),
    ):
        with refused(ValueError, "`theta`", "in rad", "np.radians("):
            call()


@pytest.mark.parametrize("normal", [np.array([2.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0]), 0])
def test_a_contact_of_one_direction(normal):
    with refused(ValueError, "independent" if np.ndim(normal) and normal[0] > 1 else "two different coordinates"):
        fj.Structure(*[np.eye(3)] * 3, np.eye(3)[0], contacts=[fj.ContactPoint(0, normal)])


def test_no_parameter_is_called_like_an_argument_of_what_takes_parameters_by_their_names():
    """It would be taken for that argument."""
    functions = fj.bistability_map, fj.basins, fj.critical_perturbation, fj.cea.chart, fj.cea.modes, fj.window
    kinds = inspect.Parameter.KEYWORD_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD
    taken = {name for one in functions for name, at in inspect.signature(one).parameters.items() if at.kind in kinds}
    assert taken | {"self"} == ARGUMENTS


@pytest.mark.parametrize("given", [None, 1.0, [1, 2], {}])
def test_what_is_no_path(given):
    for call in (
        lambda: fj.save(DATASET, given),
        lambda: fj.open(given),
        lambda: fj.read_structure(given, units="SI"),
        lambda: fj.read_matrices(given),
        lambda: fj.read_recording(given),
    ):
        with refused(TypeError, "`path`", "pathlib.Path"):
            call()


@pytest.mark.parametrize("given", [None, "a", 1.5, [1, 2], {}, True])
def test_what_is_no_node(given):
    with refused(TypeError, "`node`", "number of a node"):
        fj.NodeContact(given, "x", "y")
    if given is not None:
        with refused(TypeError, "`against`", "number of a node"):
            fj.NodeContact(1, "x", "y", given)


# --------------------------------------------------------------------------------------------- files

DATASET = xr.Dataset({"a": ("x", np.arange(3.0))})


@pytest.fixture
def breaks_midway(monkeypatch):
    """Gives a dataset and a figure whose writing fails midway, as on a full disk or at an interrupt."""

    def make(error):
        def sync(_):
            raise error

        monkeypatch.setattr(files.os, "fsync", sync)
        return {fj.save: DATASET, fj.save_figure: Figure()}

    return make


WRITERS = [(fj.save, "result.nc"), (fj.save_figure, "result.png")]
ERRORS = [OSError(28, "No space left on device"), KeyboardInterrupt(), RuntimeError("HDF error")]


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
@pytest.mark.parametrize(("writer", "name"), WRITERS, ids=["save", "save_figure"])
def test_writing_that_fails_leaves_nothing(tmp_path, breaks_midway, writer, name, error):
    """Writing that fails leaves no half a file, which could pass for a result, and no temporary file."""
    with untouched(tmp_path), pytest.raises(type(error)):
        writer(breaks_midway(error)[writer], tmp_path / name)


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
@pytest.mark.parametrize(("writer", "name"), WRITERS, ids=["save", "save_figure"])
def test_writing_that_fails_keeps_the_earlier_result(tmp_path, breaks_midway, writer, name, error):
    """Writing that fails keeps the earlier result: a full disk must not cost a night's work."""
    (tmp_path / name).write_bytes(b"the result of last night")
    with untouched(tmp_path), pytest.raises(type(error)):
        writer(breaks_midway(error)[writer], tmp_path / name)


def test_a_dataset_that_cannot_be_stored_leaves_nothing(tmp_path):
    """A real dataset that cannot be stored leaves nothing behind either, as the simulated failures above."""
    strange = DATASET.assign(b=("x", np.array([object(), object(), object()], dtype=object)))
    with untouched(tmp_path), pytest.raises((TypeError, ValueError)):
        fj.save(strange, tmp_path / "result.nc")


def test_a_picture_of_unknown_kind_leaves_nothing(tmp_path):
    """An unknown kind of picture is refused before a file is opened: no empty picture stays behind."""
    with untouched(tmp_path), pytest.raises(ValueError, match="'xyz' is not supported"):
        fj.save_figure(Figure(), tmp_path / "result.xyz")
    with pytest.raises(ValueError, match=r"must name a NetCDF file, such as `result.nc`"):
        fj.save(DATASET, tmp_path / "result.csv")


def test_results_are_whole_and_alone(tmp_path):
    """Saving replaces the earlier file by exactly what was saved, and leaves no temporary file beside it."""
    (tmp_path / "result.nc").write_bytes(b"an earlier one")
    assert fj.save(DATASET, tmp_path / "result.nc") == tmp_path / "result.nc"
    assert fj.save_figure(Figure(), tmp_path / "result.png") == tmp_path / "result.png"
    assert {path.name for path in tmp_path.iterdir()} == {"result.nc", "result.png"}
    with xr.open_dataset(tmp_path / "result.nc", engine="h5netcdf") as back:
        xr.testing.assert_identical(back.load(), DATASET)
    assert (tmp_path / "result.png").read_bytes()[1:4] == b"PNG"


def test_results_can_be_read_by_others_like_any_new_file(tmp_path):
    """A result has the permissions of any new file: colleagues can read it on a shared disk."""
    plain = tmp_path / "plain"
    plain.write_bytes(b"")
    assert fj.save(DATASET, tmp_path / "result.nc").stat().st_mode == plain.stat().st_mode


@pytest.mark.parametrize("check", [files.check_writable, lambda p: fj.save(DATASET, p), lambda p: fj.save_figure(Figure(), p)],
                         ids=["check_writable", "save", "save_figure"])  # fmt: skip
def test_paths_that_cannot_be_written(tmp_path, monkeypatch, check):
    """A path that cannot be written is refused before the work, with the reason: no result is lost to it."""
    (tmp_path / "folder").mkdir()
    with untouched(tmp_path):
        with refused(ValueError, str(tmp_path / "folder"), "is a folder"):
            check(tmp_path / "folder")
        with refused(ValueError, str(tmp_path / "missing"), "does not exist"):
            check(str(tmp_path / "missing" / "result.nc"))

        def denied(*_, **__):
            raise PermissionError(13, "Permission denied")

        # An administrator may write to any folder, so the system's refusal is simulated.
        monkeypatch.setattr(files, "try_to_write", denied)
        with refused(ValueError, str(tmp_path), "cannot be written", "Permission denied"):
            check(tmp_path / "result.nc")


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="/proc is Linux's")
def test_a_real_folder_that_nobody_can_write():
    """Whether a folder can be written is found by writing: permission bits alone mislead an administrator."""
    with refused(ValueError, "`/proc`", "cannot be written"):
        files.check_writable("/proc/result.nc")


def test_a_file_in_place_of_the_folder_is_called_a_file(tmp_path):
    """Where a file stands in place of the folder, the refusal says so, and not that the folder is missing."""
    (tmp_path / "taken").write_bytes(b"")
    with refused(ValueError, "`", "not a folder"):
        files.check_writable(tmp_path / "taken" / "result.nc")


def test_long_names_that_the_file_system_allows(tmp_path):
    """A name as long as the file system allows is accepted."""
    assert files.check_writable(tmp_path / ("x" * 252 + ".nc")).parent == tmp_path


@pytest.mark.parametrize("thing", [{"a": 1}, np.zeros(3), None], ids=["dict", "array", "None"])
def test_what_is_no_dataset(tmp_path, thing):
    """What is no dataset is refused as the argument `result`, not by an attribute that it lacks."""
    with refused(TypeError, "`result`"):
        fj.save(thing, tmp_path / "result.nc")


# -------------------------------------------------------------------------------------- command line


@pytest.mark.parametrize(
    ("arguments", "fragments"),
    [
        (["map", "--x", "mu=0.1:0.2"], ["NAME=FROM:TO:COUNT", "'mu=0.1:0.2'"]),
        (["map", "--x", "mu"], ["NAME=FROM:TO:COUNT", "'mu'"]),
        (["map", "--y", "p=a:b:3"], ["NAME=FROM:TO:COUNT", "'p=a:b:3'"]),
        (["map", "--y", "p=1:2:0"], ["at least 1 value", "COUNT is 0"]),
        (["map", "--y", "p=1:2:2.5"], ["COUNT", "'p=1:2:2.5'"]),
        (["map", "--x", "mu=0.2:0.1:3"], ["`mu`", "0.2", "0.1"]),
        (["map", "--x", "mu=0.1:0.1:3"], ["`mu`", "0.1"]),
        (["map", "--x", "mu=nan:1:3"], ["`mu`", "nan"]),
        (["map", "--x", "speed=1:2:3"], ["`speed`", "belt_speed"]),
        (["map", "--x", "p=1:2:3"], ["different", "p"]),
        (["map", "--x", "mu=-1:0.2:3"], ["`mu`", "non-negative", "-1"]),
        (["map", "--m1", "-1"], ["`m1`", "positive", "-1"]),
        (["map", "--restitution", "2"], ["`restitution`", "at most 1", "2"]),
        (["map", "--t-max", "0"], ["`t_max`", "positive", "0"]),
        (["map", "--memory", "-5"], ["`memory`", "positive", "-5"]),
        (["map", "--mu-static", "0.3"], ["--mu-dynamic"]),
        (["map", "--mu-dynamic", "0.3"], ["--mu-static"]),
        (["map", "--mu-static", "0.1", "--mu-dynamic", "0.3", "--x", "belt_speed=1:2:2"], ["`mu_static`", "0.1", "0.3"]),
        (["map", "--method", "where-switched", "--dt", "0"], ["`dt`", "positive", "0"]),
        (["simulate", "--t1", "-1"], ["`t1`", "positive", "-1"]),
        (["simulate", "--dt-save", "0"], ["`dt_save`", "positive", "0"]),
        (["simulate", "--mu", "nan"], ["`mu`", "finite", "nan"]),
        (["simulate", "--mu", "200"], ["Painlevé", "200"]),
        (["simulate", "--belt-speed", "0"], ["`belt_speed`", "zero"]),
        (["simulate", "--p", "-1"], ["`p`", "non-negative", "-1"]),
    ],
    ids=lambda x: " ".join(x) if isinstance(x, list) else None,
)  # fmt: skip
def test_command_line_refusals(tmp_path, capsys, arguments, fragments):
    """Bad input ends a command with one sentence, a failing exit code and no file: no script goes on with nothing."""
    with untouched(tmp_path):
        message = refused_on_the_command_line(capsys, [*arguments, "--out", tmp_path / "out"])
    for fragment in fragments:
        assert fragment in message


@pytest.mark.parametrize("command", ["map", "simulate"])
def test_command_line_refuses_paths_before_anything_else(tmp_path, capsys, command):
    """The output path is checked before all else: an hour's map must have somewhere to go."""
    (tmp_path / "taken.nc").mkdir()
    with untouched(tmp_path):
        message = refused_on_the_command_line(capsys, [command, "--out", tmp_path / "missing" / "out", "--m1", "-1"])
        assert str(tmp_path / "missing") in message
        message = refused_on_the_command_line(capsys, [command, "--out", tmp_path / "taken"])
        assert str(tmp_path / "taken.nc") in message


@pytest.mark.parametrize("suffix", [".nc", ".png"])
def test_a_picture_that_cannot_be_written_is_found_before_the_run(tmp_path, capsys, suffix):
    """The paths of the picture and of the data are both checked before the run."""
    (tmp_path / f"out{suffix}").mkdir()
    message = refused_on_the_command_line(capsys, ["simulate", "--out", tmp_path / "out"])
    assert f"out{suffix}" in message


@pytest.mark.parametrize("arguments", [[], ["squeal"], ["map", "--mu", "abc"], ["simulate", "--quantity", "jerk"], ["map", "--muu", "1"]],
                         ids=" ".join)  # fmt: skip
def test_command_lines_that_do_not_parse(tmp_path, monkeypatch, capsys, arguments):
    """A command line that does not parse is refused: run with defaults, it would answer another question."""
    monkeypatch.chdir(tmp_path)
    with untouched(tmp_path), pytest.raises(SystemExit) as stop:
        cli.main(arguments)
    assert stop.value.code == 2
    captured = capsys.readouterr()
    complaint = captured.err + captured.out
    assert re.search("|".join(map(re.escape, arguments[-2:] or ["subcommand"])), complaint)


@pytest.mark.parametrize("out", [".", "/", ""])
def test_an_output_without_a_name(tmp_path, monkeypatch, capsys, out):
    """An output without a file name is refused in words of this program, not of `pathlib`."""
    monkeypatch.chdir(tmp_path)
    assert "PosixPath" not in refused_on_the_command_line(capsys, ["simulate", "--out", out])


def test_an_axis_without_end(tmp_path, capsys):
    """An infinite axis is refused in a sentence, not by a NumPy warning about a multiplication."""
    message = refused_on_the_command_line(capsys, ["map", "--x", "mu=0:inf:3", "--out", tmp_path / "out"])
    assert "finite" in message


@pytest.mark.parametrize(
    "call",
    [
        lambda scene, mu: fj.limit_cycle(scene.replace(mu=mu)),
        lambda scene, mu: fj.saddle_cycle(scene.replace(mu=mu)),
        lambda scene, mu: fj.continue_cycle(scene.replace(mu=mu), "mu", (0.1, 0.3)),
        lambda scene, mu: fj.bistability_map(scene, mu=[mu]),
        lambda scene, mu: fj.critical_perturbation(scene.replace(mu=mu)),
        lambda scene, mu: fj.smallest_kick(scene.replace(mu=mu)),
        lambda scene, mu: fj.cea.modes(scene.replace(mu=mu), k1=np.linspace(9e4, 1.1e5, 3)),
        lambda scene, mu: fj.cea.chart(scene.structure, mu=np.array([0.1, 0.2]), k1=mu * np.array([5e5, 6e5])),
        lambda scene, mu: fj.cea.coalescence(scene.structure.replace(c1=mu)),
        lambda scene, mu: fj.cea.sensitivity(scene.structure.replace(c1=mu)),
        lambda scene, mu: fj.cea.complex_modes(scene.structure.replace(c1=mu), 0.2),
        lambda scene, mu: fj.cea.friction_derivative(scene.structure, mu),
        lambda scene, mu: fj.calibrate(
            scene.replace(mu=mu), fj.Recording(1e-3 * np.arange(20), {"velocity 0": np.ones(20)}), ["mu"]
        ),
        lambda scene, mu: fj.tradeoff(scene.replace(mu=mu)),
        lambda scene, mu: fj.explorer(scene.replace(mu=mu)),
        lambda scene, mu: fj.design.raise_critical_friction(scene.structure.replace(c1=mu), {"k1": (9e4, 1.1e5)}),
        lambda scene, mu: lower_growth_rate(scene.structure.replace(c1=mu), {"k1": (9e4, 1.1e5)}, mu=0.2),
        lambda scene, mu: fj.design.search_critical_friction(scene.structure.replace(c1=mu)),
    ],
)
def test_a_scene_traced_by_jax_is_refused_in_a_sentence(paper_scene, call):
    """A search whose course depends on the numbers cannot be traced: the sentence says so, and what gives derivatives."""
    with refused(TypeError, "traced", "Call this function outside"):
        jax.jit(lambda mu: (call(paper_scene, mu), mu)[1])(0.2)


def test_derivatives_of_eigenvalues_ask_for_pencils_by_name_and_for_modes_that_there_are(paper_scene):
    modes = fj.cea.complex_modes(paper_scene.structure, 0.2)
    change = {"mu": fj.cea.friction_derivative(paper_scene.structure, 0.2)}
    with refused(TypeError, "changes", "a dictionary of pencils"):
        fj.cea.eigenvalue_derivatives(modes, [1])
    for which in ([7], 0.5, [-3]):
        with refused(ValueError, "which", "indices of the 2 modes"):
            fj.cea.eigenvalue_derivatives(modes, change, which=which)
    assert fj.cea.eigenvalue_derivatives(modes, change, which=-1)["mu"].shape == (1,)
    with refused(ValueError, "mu", "must be non-negative"):
        fj.cea.friction_derivative(paper_scene.structure, -1.0)


def test_what_the_smallest_kick_may_be_sought_over_is_named(paper_scene):
    with refused(ValueError, "over", '"history"', "Did you mean `state`?"):
        fj.smallest_kick(paper_scene, over="stat")


def test_a_saddle_about_unstable_sliding_is_refused(paper_scene):
    """Where sliding is unstable no boundary surrounds it; the search used to end minutes later, and to suspect a torus."""
    with refused(ValueError, "sliding", "unstable"):
        fj.saddle_cycle(paper_scene.replace(mu=0.3))


NEXT = math.nextafter(0.2, 1.0)


class Swinging(fj.AbstractLoad):
    """A load of 1 N that swings by a billionth of it."""

    force: float = 1.0

    @property
    def jumps(self):
        return np.zeros(0)

    @property
    def final(self):
        return self.force

    def __call__(self, t):
        return self.force + 1e-9 * jax.numpy.sin(t)


@pytest.mark.parametrize(
    "refused_call",
    [
        lambda scene: fj.bistability_map(scene, mu=[NEXT, 0.2]),
        lambda scene: fj.ExponentialDecay(mu_static=0.2, mu_dynamic=NEXT),
        lambda scene: fj.continue_cycle(scene.replace(mu=NEXT), "mu", bounds=(0.1, 0.2)),
        lambda scene: fj.Structure(
            np.eye(2), np.eye(2), [[1.0, 0.2], [0.2 + 1e-8, 1.0]], [0, -1], tangential=0, normal=1
        ),
        lambda scene: fj.Scene(scene.structure, scene.friction, 3.0, Swinging()),
        lambda scene: fj.simulate(scene, 0.1, dt_save=1e-4, method=fj.WhereSwitched(dt=1e-4 * (1 + 1e-7))),
        lambda scene: arguments.real_number("share", 1 + 1e-12, maximum=1.0),
    ],
)
def test_two_numbers_that_differ_look_different(refused_call, paper_scene):
    """However near a value lies to what it was compared with, the sentence shows which is the larger."""
    with pytest.raises(ValueError, match="must") as caught:
        refused_call(paper_scene)
    numbers = [float(text) for text in re.findall(r"(?<![\w.])\d+\.?\d*(?:e-?\d+)?(?![\w])", str(caught.value))]
    near = [(a, b) for a in numbers for b in numbers if a != b and abs(a - b) < 1e-6 * abs(a)]
    assert near, str(caught.value)


def test_as_many_digits_as_it_takes():
    assert digits.apart(1.70809, 1.70809 + 1e-12) == ("1.70809", "1.708090000001")
    assert digits.apart(0.2, NEXT) == ("0.20000000000000001", "0.20000000000000004")
    assert digits.apart(100.0, 100.0, 3.5) == ("100", "100", "3.5")
    assert digits.apart(math.nan, math.inf, 1e-30) == ("nan", "inf", "1e-30")
    assert digits.apart(1 / 3, 1 / 3 + 1e-8, digits=9) == ("0.333333333", "0.333333343")


@pytest.mark.parametrize(
    ("call", "error", "fragments"),
    [
        (lambda scene: fj.Coulomb(np.ma.masked), ValueError, ["`mu`", "masked"]),
        (lambda scene: scene.replace(belt_speed=None), TypeError, ["`belt_speed`", "None"]),
        (lambda scene: fj.simulate(scene, 1.0, 5e-324), ValueError, ["`dt_save`", "rows"]),
        (lambda scene: fj.smallest_kick(scene, p_step=math.nan), ValueError, ["`p_step`", "finite"]),
        (lambda scene: fj.smallest_kick(scene, over=np.array(0.2)), TypeError, ["`over`", "list of names"]),
        (
            lambda scene: fj.smallest_kick(scene, "history", pieces=np.timedelta64(1, "s")),
            ValueError,
            ["`pieces`", "whole"],
        ),
        (
            lambda scene: fj.continue_cycle(scene, np.array(["mu", "k1"]), (0.1, 0.2)),
            ValueError,
            ["`parameter`", "array"],
        ),
        (lambda scene: fj.ContactPoint(np.timedelta64(1, "s"), 2), TypeError, ["`tangential`"]),
    ],
)
def test_what_numpy_takes_for_something_else(paper_scene, call, error, fragments):
    """Numbers without a value, spans of time for whole numbers, arrays for words."""
    with refused(error, *fragments):
        call(paper_scene)


@pytest.mark.parametrize(
    ("build", "fragments"),
    [
        (
            lambda k: (np.eye(2), np.eye(2), np.array([[k, 0.0], [0.0, k]]), np.array([0.0, -1.0])),
            ["`matrices_of`", "`jnp.array`"],
        ),
        (
            lambda k: (np.eye(2), math.sqrt(k) * np.eye(2), np.eye(2), np.array([0.0, -1.0])),
            ["`matrices_of`", "`jnp.sqrt`"],
        ),
        (lambda k: (np.eye(2) if k > 1 else 2 * np.eye(2),) * 4, ["`matrices_of`", "`jnp.where`"]),
        (lambda k: (np.eye(2),) * 3, ["`matrices_of`", "mass, damping, stiffness, load direction"]),
        (lambda k: None, ["`matrices_of`", "None"]),
    ],
)
def test_what_makes_no_matrices_of_parameters(build, fragments):
    """What needs the numbers of the parameters could not be followed by maps and derivatives."""
    with refused(TypeError, *fragments):
        fj.Structure.from_parameters(build, {"k": 1e4}, tangential=0, normal=1)


def _with_a_parameter(name: str, **settings) -> fj.Structure:
    def matrices(**parameters):
        return 3 * (jax.numpy.diag(jax.numpy.array([1.0, parameters[name]])),) + (jax.numpy.array([0.0, -1.0]),)

    return fj.Structure.from_parameters(matrices, {name: 1.0}, tangential=0, normal=1, **settings)


@pytest.mark.parametrize(
    ("result", "of", "call"),
    [
        *(
            (name, "maps", lambda scene, **axis: fj.bistability_map(scene, **axis))
            for name in ("verdict", "attractors", "amplitude", "p_crit")
        ),
        ("parameter", "critical kicks", lambda scene, **axis: fj.critical_perturbation(scene, **axis)),
        ("mode", "modes", lambda scene, **axis: fj.cea.modes(scene, **axis)),
        ("frequency", "modes", lambda scene, **axis: fj.cea.modes(scene, **axis)),
        ("margin", "stability charts", lambda scene, **axis: fj.cea.chart(scene, mu=[0.1, 0.2], **axis)),
        (
            "worst_growth_rate",
            "designs",
            lambda scene, **axis: lower_growth_rate(scene.structure, dict.fromkeys(axis, (0.9, 1.1)), mu=[0.1]),
        ),
    ],
)
def test_axes_with_names_of_results(result, of, call):
    """Refused before anything is computed."""
    scene = fj.Scene(_with_a_parameter(result), fj.Coulomb(0.2), 0.3, fj.Pulse(1.0))
    with refused(ValueError, f"`{result}`", f"a result of {of}"):
        call(scene, **{result: [0.9, 1.1]})


def test_names_of_two_parts_of_a_state():
    with refused(ValueError, "`dx`", "the velocity of `x`"):
        _with_a_parameter("k", coordinates=["x", "dx"])
    scene = fj.Scene(_with_a_parameter("x", coordinates=["x", "y"]), fj.Coulomb(0.2), 0.3, fj.ConstantLoad(1.0))
    with refused(ValueError, "Axis `x`", "a parameter of the scene"):
        fj.basins(scene, x=[0.9, 1.1], dx=[0.0, 1.0])


@pytest.mark.parametrize(
    "ask",
    [
        lambda scene: fj.simulate(scene, 0.1),
        fj.limit_cycle,
        fj.cea.growth_rate,
        lambda scene: fj.cea.critical_friction(scene.structure),
    ],
)
def test_several_scenes_in_one_are_refused_with_the_way_to_take_them(paper_scene, ask):
    with jax.enable_x64(True):
        scenes = jax.vmap(lambda mu: paper_scene.replace(mu=mu))(np.array([0.1, 0.2]))
    with refused(ValueError, "(2, 3, 3)", "`jax.vmap`"):
        ask(scenes)
