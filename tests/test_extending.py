"""Structures, laws and loads of a user's own: the page on how to write them, and what a scene refuses of them."""

import re
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refusing import refused

import fivjax as fj

PAGE = Path(__file__).parents[1] / "docs" / "extending.md"


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
    """Rejects what verdicts rely on, unkept."""
    with refused(ValueError, *fragments):
        scene_with(law)


def test_a_law_that_rises_past_painleve_s_limit_is_refused_where_its_slip_is_reached():
    """Rejects a limit that is asked of `static` alone: this law is beyond it at the belt's speed, and ran all the same."""
    with refused(ValueError, "no unique solution", "Painlevé's limit", "108.5"):
        fj.simulate(scene_with(Law(0.3, 150.0)), 0.1)


def test_a_law_with_unknown_numbers_passes():
    """Shows that maps and derivatives over a law's own parameters are not stopped by a check that cannot look."""

    def static(change):
        return scene_with(Law(0.3, change)).friction(jnp.asarray(1.0))

    with jax.enable_x64(True):
        assert float(jax.jit(static)(-0.1)) == pytest.approx(0.3 - 0.1 * (1 - np.exp(-1)), rel=1e-14)


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
