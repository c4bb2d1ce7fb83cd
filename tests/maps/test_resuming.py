"""By what a resumed map is recognised: everything that determines its bits."""

import re
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fivjax as fj
from fivjax.foundation.precision import in_double_precision
from fivjax.foundation.traced_code import digest, is_from_outside
from fivjax.maps import engine
from tests.helpers import stand_in_jobs

AXES = {"mu": [0.1, 0.15, 0.2], "p": [1.2, 2.5]}


@pytest.fixture(autouse=True)
def stood_in(monkeypatch):
    monkeypatch.setattr(engine, "run_job", lambda job, *_: stand_in_jobs.run(job))


def law(drop, factor=1.0):
    """A falling law of a user's own; `drop` is in its code, `factor` a field that is no parameter."""

    class Falling(fj.AbstractFriction):
        mu: float
        factor: float = eqx.field(static=True, default=1.0)
        constant = False

        @property
        def static(self):
            return self.mu

        def __call__(self, slip_speed):
            return self.mu * (1 - self.factor * drop * (1 - jnp.exp(-slip_speed)))

        def variation(self, slip_speed):
            bound = self.factor * self.mu * drop * jnp.exp(-slip_speed)
            return bound, bound

    return Falling(0.2, factor)


def own_structure(share):
    """A structure of a user's own, the same at k1 = 100 kN/m whatever the `share`."""

    def matrices(k1):
        return fj.belt_oscillator(k1=100e3 + share * (k1 - 100e3)).matrices

    like = fj.belt_oscillator()
    places = {"tangential": like.tangential, "normal": like.normal, "coordinates": like.coordinates}
    return fj.Structure.from_parameters(matrices, {"k1": 100e3}, **places)


def own_stepper(share):
    """A stepper of a user's own, which goes on by part of the time."""

    class Halved(fj.EventExact):
        def advance(self, mechanics, contact, load, y, h, at_section=False):
            return super().advance(mechanics, contact, load, y, share * h, at_section)

    return Halved()


def scene(friction=None, structure=None) -> fj.Scene:
    friction = fj.Coulomb(0.2) if friction is None else friction
    return fj.Scene(fj.belt_oscillator() if structure is None else structure, friction, 3.0, fj.Pulse(100.0, 1.2))


def kept(path, own: fj.Scene, **options):
    return fj.bistability_map(own, resume=path, progress=False, **{**AXES, **options})


@pytest.mark.parametrize("kind", ["part", "zarr"])
def test_axes_in_another_order_are_another_map(tmp_path, kind):
    """Rejects values that are taken over transposed."""
    if kind == "zarr":
        pytest.importorskip("zarr")
    path = tmp_path / f"map.{kind}"
    kept(path, scene())
    with pytest.raises(ValueError, match="its axes are in the order mu, p and not p, mu"):
        fj.bistability_map(scene(), resume=path, progress=False, **dict(reversed(AXES.items())))


def test_a_time_limit_is_a_number_whatever_library_made_it(tmp_path):
    """1 is 1.0; and what was given as NumPy's or JAX's could not be written at all."""
    path = tmp_path / "map.part"
    first = kept(path, scene(), t_max=1.0)
    for limit in (1, np.int64(1), np.float32(1.0), jnp.asarray(1.0)):
        assert kept(path, scene(), t_max=limit).equals(first)


@pytest.mark.parametrize(
    ("first", "second", "part"),
    [
        (lambda: scene(law(0.1)), lambda: scene(law(0.3)), "friction law"),
        (lambda: scene(law(0.1)), lambda: scene(law(0.1, 2.0)), "friction law"),
        (lambda: scene(structure=own_structure(1.0)), lambda: scene(structure=own_structure(1.1)), "structure"),
    ],
    ids=["code", "static field", "structure"],
)
def test_other_code_under_the_same_name_is_refused(tmp_path, first, second, part):
    path = tmp_path / "map.part"
    kept(path, first())
    kept(path, first())  # defined anew, but the same
    with pytest.raises(ValueError, match=f"of another run: the code of its {part}"):
        kept(path, second())


def of_speed(slip_speed):
    return 1 - 0.05 * jnp.tanh(slip_speed)


class Helped(fj.AbstractFriction):
    """Its code is elsewhere."""

    mu: float

    def __call__(self, slip_speed):
        return self.mu * of_speed(slip_speed)


def test_what_a_law_calls_is_part_of_its_code(tmp_path, monkeypatch):
    path = tmp_path / "map.part"
    kept(path, scene(Helped(0.2)))
    monkeypatch.setitem(globals(), "of_speed", lambda slip_speed: 1 - 0.1 * jnp.tanh(slip_speed))
    with pytest.raises(ValueError, match="of another run: the code of its friction law"):
        kept(path, scene(Helped(0.2)))


def test_a_changed_stepper_of_a_users_own_is_refused(tmp_path):
    path = tmp_path / "map.part"
    kept(path, scene(), method=own_stepper(0.5))
    kept(path, scene(), method=own_stepper(0.5))
    with pytest.raises(ValueError, match="the code of its stepper"):
        kept(path, scene(), method=own_stepper(0.25))


def test_what_is_told_from_outside():
    assert not is_from_outside(fj.EventExact()) and not is_from_outside(fj.WhereSwitched())
    assert is_from_outside(own_stepper(0.5)) and is_from_outside(partial(print, law))


@in_double_precision
def test_a_digest_tells_what_is_computed_and_nothing_else():
    """Constants, tables, branches, loops and derivatives count; names and addresses do not."""

    def function(table, power, rule):
        @jax.custom_jvp
        def own(x):
            return x**2

        own.defjvp(lambda at, along: (own(*at), rule * at[0] * along[0]))

        def one(x):
            y = jax.lax.cond(x > 0, lambda x: jnp.interp(x, np.arange(3.0), table), lambda x: -x, x)
            return own(jax.lax.fori_loop(0, 3, lambda _, y: y**power, y))

        return lambda x: jax.jvp(one, (x,), (x,))

    at = jnp.ones(())
    table = np.array([0.0, 1.0, 4.0])
    first = digest(function(table, 2, 2.0), at)
    assert first == digest(function(table.copy(), 2, 2.0), at)
    others = [function(table + 1e-16 * (table == 0), 2, 2.0), function(table, 3, 2.0), function(table, 2, 2.5)]
    assert len({first, *(digest(one, at) for one in others)}) == 4


@in_double_precision
def test_a_digest_of_what_jax_does_not_trace_is_that_of_its_code():
    def host(factor):
        return lambda x: jax.pure_callback(lambda x: factor * np.asarray(x), jax.ShapeDtypeStruct((), x.dtype), x)

    def untraced(factor):
        return lambda x: float(x) * factor

    at = jnp.ones(())
    for kind in (host, untraced):
        assert digest(kind(2.0), at) == digest(kind(2.0), at) != digest(kind(3.0), at)


def test_a_run_names_the_versions_that_its_bits_depend_on(tmp_path, monkeypatch):
    path = tmp_path / "map.part"
    kept(path, scene())
    real = engine.run_to_verdict.__globals__["jax"].__version__
    monkeypatch.setattr("fivjax.maps.resuming.metadata.version", lambda name: "0.1" if name == "jax" else real_of(name))
    with pytest.raises(ValueError, match=re.escape(f'its `jax` is "{real}" and not "0.1"')):
        kept(path, scene())


def real_of(name: str) -> str:
    from importlib.metadata import distribution

    return distribution(name).version
