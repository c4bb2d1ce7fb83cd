"""The types and shapes in annotations hold for what really happens: jaxtyping and beartype look at every call."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

# In a process of its own, because the package has to be imported under the hook. An `int` passes for a `float`, as for
# every static checker (PEP 484); beartype asks for that to be said.
CHECKED = """
import importlib, pkgutil, sys, types
import jax, jaxtyping
import numpy as np
from beartype import BeartypeConf, beartype
from jaxtyping import install_import_hook

checker = types.ModuleType("checker")
checker.checked = beartype(conf=BeartypeConf(is_pep484_tower=True))
sys.modules["checker"] = checker

ROOMS = ["foundation", "kernels", "model", "contact", "steppers", "linear", "simulation", "cycles"]
PROOFS = ["verdicts." + name for name in ("sliding_proof", "slow_growth", "sticking_proof", "verdict")]

# What an earlier test traced is not looked for: the checker is at work while JAX traces.
def not_kept(path):
    raise FileNotFoundError(path)


# Where values are known, kernels and NumPy compute; shapes and kinds of numbers are as annotated for JAX.
jaxtyping.Array = jax.Array | np.ndarray | np.generic

with install_import_hook(["fivjax." + name for name in ROOMS + PROOFS], "checker.checked"):
    for name in [*ROOMS, "verdicts"]:
        room = importlib.import_module("fivjax." + name)
        for module in pkgutil.iter_modules(room.__path__, room.__name__ + "."):
            importlib.import_module(module.name)

from fivjax.foundation import kept_programs

kept_programs._read = not_kept
"""

WORK = """
import warnings

import fivjax as fj
import fivjax.maps.groups
import fivjax.steppers.kernel_scope

scene = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.227), belt_speed=3.0, load=fj.Pulse(100.0, 1.2))
run = fj.simulate(scene, 0.02, 2e-3, energy=True)
assert run.slip_velocity.shape == run.gap.shape == run.t.shape
assert fj.cea.eigenvalues(scene).shape == (4,)
assert 0.227 < fj.cea.critical_friction(fj.belt_oscillator()) < 0.229
# Warp's functions have types of their own.
warnings.simplefilter("ignore")
fivjax.steppers.kernel_scope.is_installed = lambda: False
found = fj.bistability_map(scene, mu=[0.1, 0.227], p=[1.0, 1.1, 1.2, 1.3], t_max=0.5, progress=False)
assert found["verdict"].shape == (2, 4)
"""

# The proofs of two contacts, in as many scenes and in more, under constant and under falling friction.
PROOFS_TOGETHER = """
import jax
import numpy as np
import jax.numpy as jnp
from fivjax.contact import Contact, Mechanics
from fivjax.linear.linearisation import linear_sliding
from fivjax.verdicts.sliding_proof import margin_share_bound, sliding_modes

contacts = [fj.ContactPoint(0, 1), fj.ContactPoint(2, 3)]
structure = fj.Structure(np.eye(4), 0.1 * np.eye(4), np.diag([1.0, 5.0, 2.0, 5.0]), [0, -1, 0, -1], contacts=contacts)
with jax.enable_x64(True):
    for law in (fj.Coulomb(0.2), fj.ExponentialDecay(0.21, 0.2, 0.5)):
        scene = fj.Scene(structure, [law, law], 0.5, fj.ConstantLoad(1.0))
        linear = jax.tree.map(np.asarray, linear_sliding(scene))
        for groups in (2, 3):
            modes = sliding_modes(jax.tree.map(lambda leaf: np.stack([leaf] * groups), linear))
            assert modes.pressing.shape == (groups, 2, 2)
        modes = jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), modes)
        contact = Contact(jnp.ones(2, jnp.int32), jnp.ones(2))
        assert margin_share_bound(Mechanics(scene), modes, contact, 1e-6 * jnp.eye(8)[0], True) < 1
"""

MISTAKE = """
import jax.numpy as jnp
from jaxtyping import TypeCheckError
from fivjax.contact import Contact

try:
    Contact(jnp.zeros(3, int), jnp.zeros(4))
except TypeCheckError as refused:
    assert "direction" in str(refused)
else:
    raise AssertionError("a status for three and a direction for four went through")
"""


def in_process(code: str) -> subprocess.CompletedProcess:
    paths = [str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, paths))}
    return subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)


@pytest.mark.slow
def test_annotations_hold_in_a_simulation_a_stability_limit_and_a_map():
    """No annotation says what is not so; and the checker is at work, because it refuses arrays that do not match."""
    done = in_process(CHECKED + WORK + PROOFS_TOGETHER + MISTAKE)
    assert done.returncode == 0, done.stderr[-3000:]
