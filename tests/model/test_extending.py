"""Structures, laws and loads of a user's own: the page on how to write them, and what a scene refuses of them."""

import re
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import fivjax as fj
from fivjax.verdicts.sliding_proof import why_withheld
from tests.helpers.refusing import refused

PAGE = Path(__file__).parents[2] / "docs" / "extending.md"


def test_the_page_runs_as_it_stands():
    """Rejects a page whose code has fallen behind the library."""
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(), flags=re.S)
    assert len(blocks) == 4
    exec(compile("\n".join(blocks), str(PAGE), "exec"), {"__name__": "extending"})


class Law(fj.AbstractFriction):
    """Friction `at_rest` that changes by `change` as slip sets in."""

    at_rest: float
    change: float
    held: float | None = None
    bounded: float = 1.0
    constant = False

    @property
    def static(self):
        return self.at_rest if self.held is None else self.held

    def __call__(self, slip_speed):
        return self.at_rest + self.change * (1 - jnp.exp(-slip_speed))

    def variation(self, slip_speed):
        bound = self.bounded * jnp.abs(self.change) * jnp.exp(-slip_speed)
        return bound, bound


class Ramp(Law):
    """It says that it is constant, and is not."""

    constant = True


def scene_with(friction: fj.AbstractFriction) -> fj.Scene:
    return fj.Scene(fj.belt_oscillator(), friction, 3.0)


def test_a_law_is_held_in_double_precision_whatever_its_numbers_come_as():
    """Rejects parameters that stay Python's or NumPy's and become single precision once JAX has them."""
    scene = scene_with(Law(0.3, np.float32(-0.1)))
    for name, value in {"at_rest": 0.3, "change": float(np.float32(-0.1))}.items():
        assert scene.parameters[name].dtype == np.float64
        assert float(scene.parameters[name]) == value
    assert float(scene.replace(at_rest=0.25).friction.at_rest) == 0.25


@pytest.mark.parametrize(
    ("law", "fragments"),
    [
        (Law(0.3, -0.4), ["not be negative"]),
        (Law(0.3, np.nan), ["finite"]),
        (Law(0.3, -0.1, bounded=0.5), ["`variation`", "|μ'|"]),
        (Ramp(0.3, -0.1), ["`constant`"]),
        (Law(0.3, -0.1, held=0.2), ["`static`"]),
    ],
    ids=["negative", "nan", "bounds", "constant", "static"],
)
def test_a_law_that_breaks_its_contract_is_refused(law, fragments):
    """Rejects what verdicts and Painlevé's limit rely on, unkept: a rising law ran far beyond that limit."""
    with refused(ValueError, *fragments):
        scene_with(law)


@pytest.mark.parametrize(
    ("result", "fragments"),
    [
        (lambda v: np.exp(-v), ["`jax.numpy`", "`jnp.where`"]),
        (lambda v: 1.0 if v < 0.5 else 0.5, ["`jax.numpy`", "`jnp.where`"]),
        (lambda v: jnp.exp(-v).astype(jnp.float32), ["float32"]),
        (lambda v: 1, ["int64"]),
        (lambda v: jnp.exp(-v)[None], ["(1,)"]),
        (lambda v: jnp.exp(-v) + 0j, ["complex128"]),
        (lambda v: (v, v), ["("]),
    ],
    ids=["numpy", "if", "single", "whole", "vector", "complex", "two"],
)
def test_a_law_is_a_jax_function_of_a_number_to_a_number(result, fragments):
    """Rejects what ended in errors of JAX and NumPy in the middle of a run."""
    law = type("Own", (fj.AbstractFriction,), {"__call__": lambda self, slip_speed: result(slip_speed)})
    with refused(TypeError, "`Own`", *fragments):
        scene_with(law())


@pytest.mark.slow
def test_a_motion_that_fades_below_all_numbers_has_no_events():
    """Without bounds on its variation nothing is proved of a law, so a motion is followed until its steps take no time."""
    law = type("Bare", (Law,), {"variation": fj.AbstractFriction.variation})
    structure = fj.Structure(np.eye(2), np.diag([0.1, 1.0]), np.eye(2), [0.0, -1.0], tangential=0, normal=1)
    scene = fj.Scene(structure, law(0.2, 0.01), 0.3, fj.Pulse(1.0, 3.0, duration=2.0))
    m = fj.bistability_map(scene, p=[1.0, 1.3], t_max=1e5, progress=False)
    assert m.verdict.values.tolist() == [fj.Verdict.UNDECIDED] * 2 and m.contact_events.values.tolist() == [0, 0]


def test_a_law_may_rise_above_its_static_value_but_not_to_painleves_limit():
    """Rejects refusing a viscous branch that only counts at speeds never reached, and running far beyond the limit."""
    scene = scene_with(Law(0.3, 150.0))  # 142.8 at the belt's speed, where the limit is 108.5
    with refused(ValueError, "no unique solution", "142.8"):
        fj.simulate(scene, 0.1)
    assert fj.simulate(scene_with(Law(0.3, 1.0)), 0.01, 0.01).meaning == "reached its end"


class Table(fj.AbstractFriction):
    """The least that a law is: a function of slip speed. Piecewise linear, by a loop within `jnp.interp`."""

    mu: np.ndarray
    speeds: np.ndarray
    lift: float = 0.0

    def __call__(self, slip_speed):
        return jnp.interp(slip_speed, self.speeds, self.mu) + self.lift


KNOTS, AT_KNOTS = np.array([0.0, 0.05, 0.3, 0.9]), np.array([0.6, 0.35, 0.3, 0.45])
SPEED, RUBBING = 0.5, 0.02


def on_a_table(knots=KNOTS, values=AT_KNOTS, **options) -> fj.Scene:
    structure = fj.Structure(np.eye(2), np.diag([RUBBING, 0.0]), np.diag([1.0, 0.0]), [0.0, -1.0], 0, 1)
    return fj.Scene(structure, Table(values, knots, **options), SPEED, fj.ConstantLoad(1.0))


def followed(knots, values, y, ends) -> np.ndarray:
    """The block of `on_a_table` by SciPy: one law for each piece, extended beyond it, and an event at each end of it."""
    t, y, found, slope = 0.0, np.array(y), [], np.append(np.diff(values) / np.diff(knots), 0.0)
    way, piece, sticks = 1.0, int(np.searchsorted(knots, SPEED - y[1], side="right")) - 1, False
    while t < ends[-1]:
        if sticks:
            at, start = min(t + (values[0] - RUBBING * SPEED - y[0]) / SPEED, ends[-1]), y[0]
            found += [[start + SPEED * (end - t), SPEED] for end in ends if t < end <= at]
            t, y, way, piece, sticks = at, np.array([start + SPEED * (at - t), SPEED]), 1.0, 0, False
            continue

        def rates(_, y, piece=piece, way=way):
            mu = values[piece] + slope[piece] * (way * (SPEED - y[1]) - knots[piece])
            return [y[1], -y[0] - RUBBING * y[1] + way * mu]

        edges = [lambda _, y, piece=piece, way=way: way * (SPEED - y[1]) - knots[piece]]
        if piece + 1 < len(knots):
            edges.append(lambda _, y, piece=piece, way=way: knots[piece + 1] - way * (SPEED - y[1]))
        for edge in edges:
            edge.terminal, edge.direction = True, -1
        run = solve_ivp(
            rates, (t, ends[-1]), y, "DOP853", events=edges, dense_output=True, rtol=1e-13, atol=1e-15, max_step=0.1
        )
        found += [run.sol(end) for end in ends if t < end <= run.t[-1]]
        t, y = run.t[-1], run.y[:, -1]
        if run.status == 1 and len(run.t_events[0]) == 0:
            piece += 1
        elif run.status == 1 and piece > 0:
            piece -= 1
        elif run.status == 1:
            pull = y[0] + RUBBING * SPEED
            y[1], sticks, way = SPEED, abs(pull) <= values[0], np.sign(pull)
    return np.array(found)


@pytest.mark.parametrize(
    ("knots", "values", "start"),
    [
        (KNOTS, AT_KNOTS, (0.0, -0.2)),
        (KNOTS, AT_KNOTS, (0.1, SPEED - 0.3)),  # at a kink to begin with
        (
            np.array([0.0, 0.02, 0.34, 0.73]),
            np.array([0.23, 0.57, 0.24, 0.5]),
            (0.2, -0.2),
        ),  # the last kink is passed just before rest
    ],
    ids=["kinks", "at a kink", "a kink near rest"],
)
def test_a_law_with_kinks_is_followed_exactly(knots, values, start):
    """Rejects steps that go over a kink: rows half a second apart are those of a solver that ends its steps there."""
    run = fj.simulate(on_a_table(knots, values), 10.0, 0.5, y0=([start[0], 0.0], [start[1], 0.0]))
    mine = np.stack([run.displacement[1:, 0], run.velocity[1:, 0]], axis=1)
    np.testing.assert_allclose(mine, followed(knots, values, start, run.t[1:]), atol=1e-10)


@pytest.mark.slow
def test_derivatives_through_kinks():
    """Where a step ends at a kink is no event: the derivative is that of differences."""

    def last(lift):
        run = fj.simulate(on_a_table(lift=lift), 4.0, 0.5, y0=([0.0, 0.0], [-0.2, 0.0]), derivatives="forward")
        return run.velocity[-1, 0]

    with jax.enable_x64(True):
        slope = jax.jacfwd(last)(0.0)
    assert float(slope) == pytest.approx((last(1e-5) - last(-1e-5)) / 2e-5, rel=1e-7)


def test_what_proofs_need_of_a_law_and_cannot_have_is_said():
    """Rejects proofs that rest on a second derivative which a law with kinks does not have, whatever its author says."""

    class Bounded(Table):
        def variation(self, slip_speed):
            return jnp.full_like(slip_speed, 10.0), jnp.zeros_like(slip_speed)

    scene = on_a_table()
    law = Bounded(AT_KNOTS, KNOTS)
    assert "kinks" in str(why_withheld(fj.Scene(scene.structure, law, SPEED)))
    with jax.enable_x64(True):
        assert np.isinf(law.bounds(jnp.asarray(0.3))[1])
    assert why_withheld(scene_with(Law(0.3, -0.1))) is None
    # Smooth, but without bounds: nothing is known of it.
    bare = type("Bare", (Law,), {"variation": fj.AbstractFriction.variation})
    assert "no finite bounds" in str(why_withheld(scene_with(bare(0.3, -0.1))))


def test_a_law_with_a_word_for_a_parameter_is_refused():
    class Named(Law):
        name: str = "a law"

    class Sampled(Half):
        source: str = "a file"

    with refused(TypeError, "`Named`", "a str", "static=True"):
        scene_with(Named(0.3, -0.1))
    with refused(TypeError, "load `Sampled`", "a str"):
        fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.2), load=Sampled(1.0, 1.0))


def test_a_law_that_rounds_to_single_precision_is_refused():
    class Single(Law):
        def __call__(self, slip_speed):
            return super().__call__(
                jax.lax.fori_loop(0, 2, lambda k, v: v.astype(np.float32).astype(v.dtype), slip_speed)
            )

    with refused(TypeError, "`Single`", "double precision", "astype"):
        scene_with(Single(0.3, -0.1))


def test_a_number_of_pythons_in_a_law_is_a_parameter_still():
    """`eqx.tree_at` puts it there, past all constructors. Rejects forgetting it in what is saved."""
    scene = fj.Scene(fj.belt_oscillator(), [fj.Coulomb(0.2, 0.3)])  # a list for one contact, too
    own = lambda s: s.friction.mu_static  # noqa: E731
    changed = eqx.tree_at(own, scene, 0.5)
    assert set(changed.parameters) == set(scene.parameters)
    run = fj.simulate(changed, 0.01, 0.01)
    assert float(own(fj.Scene.from_dataset(run.to_dataset()))) == 0.5


def test_a_law_that_jumps_is_refused():
    """Rejects friction that would change to and fro without end where slip is driven back over the jump."""

    class Jump(fj.AbstractFriction):
        def __call__(self, slip_speed):
            return jnp.where(slip_speed < 0.7, 0.4, 0.3)

    with refused(ValueError, "continuous", "`Jump`"):
        scene_with(Jump())


def test_a_law_with_unknown_numbers_passes():
    """Shows that maps and derivatives over a law's own parameters are not stopped by a check that cannot look."""

    def static(change):
        return scene_with(Law(0.3, change)).friction(jnp.asarray(1.0))

    with jax.enable_x64(True):
        assert float(jax.jit(static)(-0.1)) == pytest.approx(0.3 - 0.1 * (1 - np.exp(-1)), rel=1e-14)


class Half(fj.AbstractLoad):
    """A load with a value that nothing else tells of."""

    force: float
    mid: float

    @property
    def jumps(self):
        return np.array([0.0, 0.01])

    @property
    def final(self):
        return self.force

    def __call__(self, t):
        return jnp.where((t >= 0) & (t < 0.01), self.mid, self.force)


def test_a_load_with_unknown_numbers_passes():
    """Its check cannot look either; differences of two runs are the reference."""

    def displacement(mid):
        scene = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.2), belt_speed=0.8, load=Half(100.0, mid))
        return fj.simulate(scene, 0.02, 0.01).displacement[-1, 0]

    with jax.enable_x64(True):
        slope = float(jax.grad(displacement)(150.0))
    assert slope == pytest.approx(float(displacement(151.0) - displacement(149.0)) / 2, rel=1e-6)


class Load(fj.AbstractLoad):
    """What it says of itself, and what it does, apart."""

    force: float = 1.0
    end: float = 2.0
    times: tuple[float, ...] = eqx.field(static=True, default=(1.0,))
    drift: float = 0.0

    @property
    def jumps(self):
        return jnp.array(self.times, float)

    @property
    def final(self):
        return self.end

    def __call__(self, t):
        return jnp.where(t < 1.0, 1.0, 2.0) + self.drift * t


@pytest.mark.parametrize(
    ("load", "fragments"),
    [
        (Load(times=(1.0, 0.5)), ["in order"]),
        (Load(times=()), ["`final`"]),
        (Load(drift=0.1), ["constant between its jumps"]),
        (Load(force=3.0), ["`force`", "before its first jump"]),
        (Load(end=3.0), ["`final`", "after its last jump"]),
    ],
)
def test_a_load_that_breaks_its_contract_is_refused(load, fragments):
    """Rejects a jump that no step would end at, and a load that starts from another equilibrium than it says."""
    with refused(ValueError, "`Load`", *fragments):
        fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.2), 3.0, load)
    assert fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.2), 3.0, Load()).load.force.dtype == np.float64


def _law_with(power: int):
    """A class `Fading` of its own each time, as when a notebook's cell is run again."""

    class Fading(fj.AbstractFriction):
        mu: jax.Array
        exponent: int = eqx.field(static=True, default=1)

        def __call__(self, slip_speed):
            return self.mu / (1 + slip_speed) ** (power * self.exponent)

    return Fading


def test_a_law_comes_back_with_its_fixed_fields_and_as_the_class_is_now(paper_scene):
    laws = [_law_with(power) for power in (1, 2)]
    later = fj.Scene(paper_scene.structure, laws[1](jnp.float32(0.2), exponent=3), 1.0)
    back = fj.Scene.from_dataset(fj.simulate(later, 0.01, 0.01).to_dataset())
    assert type(back.friction) is laws[1] and back.friction.exponent == 3
    earlier = fj.Scene(paper_scene.structure, laws[0](jnp.float32(0.2), exponent=3), 1.0)
    with pytest.raises(ValueError, match="is a `Fading`, but the class of that name computes something else now"):
        fj.Scene.from_dataset(fj.simulate(earlier, 0.01, 0.01).to_dataset())


class TableAsGiven(fj.AbstractFriction):
    """Friction by a table, in arrays as they are given."""

    speeds: jax.Array
    values: jax.Array

    def __call__(self, slip_speed):
        return jnp.interp(slip_speed, self.speeds, self.values)


def _steps(count: int):
    class Steps(fj.AbstractLoad):
        force: float
        times: jax.Array
        levels: jax.Array

        @property
        def jumps(self):
            return self.times[:count]

        @property
        def final(self):
            return self.levels[count - 1]

        def __call__(self, t):
            before = jnp.searchsorted(self.times[:count], t, side="right")
            return jnp.where(before > 0, self.levels[jnp.maximum(before - 1, 0)], self.force)

    return Steps


def test_laws_and_loads_with_arrays_come_back(paper_scene):
    """In a file they are lists, of which JAX takes none; one had lost its parameters."""
    law = TableAsGiven(np.array([0.0, 1.0, 50.0]), np.array([0.2, 0.15, 0.14]))
    load = _steps(2)(100.0, np.array([0.001, 0.002]), np.array([110.0, 90.0]))
    scene = fj.Scene(paper_scene.structure, law, 1.0, load)
    dataset = fj.simulate(scene, 0.003, 1e-3).to_dataset()
    back = fj.Scene.from_dataset(dataset)
    assert set(back.parameters) == set(scene.parameters) >= {"speeds", "values", "levels"}
    for own, other in zip(jax.tree.leaves(back), jax.tree.leaves(scene), strict=True):
        np.testing.assert_array_equal(own, other)
    # The latest class of that name has fewer jumps.
    later = _steps(1)
    with pytest.raises(ValueError, match="is a `Steps`, but the class of that name computes something else now"):
        fj.Scene.from_dataset(dataset)
    assert later.__name__ == "Steps"
