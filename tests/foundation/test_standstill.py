"""Nothing waits for ever: linear algebra without LAPACK in whatever steps trajectories, and maps of many coordinates that end."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import fivjax as fj
from fivjax.contact import Contact, Status
from fivjax.foundation import linear_solve, matrix_factors, matrix_routines
from fivjax.foundation.flattened import Flattened, flatten
from fivjax.maps import following, groups
from fivjax.maps.one_trajectory import TaskConstants
from fivjax.steppers.event_exact import EventExact
from tests.helpers.chains import chain

PACKAGE = Path(fj.__file__).parent
ROOT = Path(__file__).parents[2]
# Modules of JAX whose functions call LAPACK, but for the one that does not.
LINEAR_ALGEBRA = ("jnp.linalg", "jax.numpy.linalg", "jax.lax.linalg", "jax.scipy", "lax.linalg")
PRIMITIVES = {one.name for name, one in vars(jax.lax.linalg).items() if name.endswith("_p") and hasattr(one, "name")}


@pytest.fixture(autouse=True)
def double_precision():
    with jax.enable_x64(True):
        yield


def test_one_module_calls_lapack():
    """All others go through it, or through elimination: what is called here is called in programs that run side by side."""
    callers, users = set(), set()
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Attribute):
                name = ast.unparse(node)
                if name.startswith(tuple(f"{module}." for module in LINEAR_ALGEBRA)) and name != "jnp.linalg.norm":
                    callers.add(str(path.relative_to(PACKAGE)))
            if isinstance(node, ast.ImportFrom) and "matrix_routines" in ast.unparse(node):
                users.add(path.parent.name)
    assert callers == {"foundation/matrix_routines.py"}
    # Linear theory, and the multipliers of one cycle that a user asks for; and what makes LAPACK known to programs that were kept.
    assert users <= {"linear", "cycles", "foundation"}


def called(jaxpr, found: set[str]) -> set[str]:
    """The names of the primitives of a program, with those of what it calls."""
    for equation in jaxpr.eqns:
        found.add(equation.primitive.name)
        for value in jax.tree.leaves(list(equation.params.values()), is_leaf=lambda v: hasattr(v, "eqns")):
            inner = getattr(value, "jaxpr", value)
            if hasattr(inner, "eqns"):
                called(inner, found)
    return found


def of_program(function, *arguments):
    """The primitives of a program, and arrays of zeros in the form of its result."""
    traced, form = jax.make_jaxpr(function, return_shape=True)(*arguments)
    return called(traced.jaxpr, set()), jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), form)


def test_a_batch_of_trajectories_has_no_lapack():
    scene, names = chain(12, 1), ("mu",)
    method = EventExact()
    own = np.full((2, 1), 0.3)
    of_values, scenes = of_program(lambda rows: groups._scenes.__wrapped__(scene, names, rows), own)
    of_preparing, (mechanics, linear, *rest) = of_program(groups._prepare.__wrapped__, scenes)
    assert "while" in of_preparing or "scan" in of_preparing, "elimination is a loop"
    for part in ("matrix", "frictionless"):
        getattr(linear, part)[:] = -np.eye(linear.matrix.shape[-1])
    shared = flatten(groups.GroupConstants(scenes, mechanics, groups.sliding_modes(linear), *rest))
    columns = flatten((np.zeros((2, 1)), np.zeros((2, 0))))
    rows = Flattened(columns.numbers[np.zeros((2, 4), int)], columns.form)

    of_task = TaskConstants(("p",), method, False)

    def begin(shared, rows):
        return following._begin_block.__wrapped__(of_task, shared, rows)

    def follow(shared, rows):
        return following._follow_rows(of_task, np.int32(4), shared, rows)

    of_beginning, begun = of_program(begin, shared, rows)
    of_following, _ = of_program(follow, shared, begun)
    assert not PRIMITIVES & (of_values | of_preparing | of_beginning | of_following)


def test_a_step_of_many_contacts_has_no_lapack():
    scene = chain(14, 6)
    of_mechanics, mechanics = of_program(lambda _: groups.mechanics_about_sliding(scene), 0.0)
    contact = Contact(jnp.full(6, Status.SLIDE, jnp.int32), jnp.ones(6))

    def step(mechanics, y):
        return EventExact().advance(mechanics, contact, jnp.zeros(()), y, jnp.ones(()), True)

    of_step, _ = of_program(step, mechanics, np.zeros(28))
    assert not PRIMITIVES & (of_mechanics | of_step)


def test_lapack_would_be_seen():
    """The programs are searched through loops and whatever else calls others."""

    def looping(a):
        return jax.lax.fori_loop(0, 3, lambda _, b: jax.jit(jnp.linalg.solve)(a, b), a)

    assert PRIMITIVES & of_program(looping, np.eye(3))[0]


@pytest.mark.parametrize("n", [4, 11])
def test_elimination_against_numpy(n):
    """Written out and in a loop; a matrix that needs pivots, a batch, several right-hand sides, derivatives."""
    rng = np.random.default_rng(n)
    matrix, right = rng.normal(size=(3, n, n)), rng.normal(size=(3, n, 2))
    matrix[0, 0, 0] = 0.0
    found = jax.jit(jax.vmap(linear_solve.solve))(matrix, right)
    np.testing.assert_allclose(found, np.linalg.solve(matrix, right), rtol=1e-9, atol=1e-11)
    determinants, slopes = jax.jit(jax.vmap(jax.value_and_grad(linear_solve.determinant)))(matrix)
    inverse = np.linalg.inv(matrix)
    np.testing.assert_allclose(determinants, np.linalg.det(matrix), rtol=1e-10)
    cofactors = determinants[:, None, None] * np.swapaxes(inverse, 1, 2)
    np.testing.assert_allclose(slopes, cofactors, rtol=1e-8, atol=1e-10 * np.max(np.abs(cofactors)))


def test_singular_and_undefined_systems():
    singular = jnp.ones((3, 3))
    assert not np.any(np.isfinite(jax.jit(linear_solve.solve)(singular, jnp.arange(3.0))))
    determinant = jax.jit(linear_solve.determinant)
    assert determinant(singular) == 0 and np.isnan(determinant(singular * jnp.nan))


@pytest.mark.parametrize("size", [1.0, 50.0])
def test_exponential_against_scipy(size):
    rng = np.random.default_rng(3)
    matrix = rng.normal(size=(12, 12)) * size / np.sqrt(12)
    matrix = matrix - matrix.T - 0.1 * size * np.eye(12)
    along = rng.normal(size=(12, 12))
    found, slope = jax.jit(lambda a, b: jax.jvp(matrix_factors.exponential, (a,), (b,)))(matrix, along)
    value, change = scipy.linalg.expm_frechet(matrix, along)
    np.testing.assert_allclose(found, value, atol=1e-12 * np.max(np.abs(value)))
    np.testing.assert_allclose(slope, change, atol=1e-12 * np.max(np.abs(change)))


def test_orthonormal_columns():
    columns = np.vander(np.linspace(0, 1, 40), 8)  # nearly dependent: condition 10⁶
    q, upper = jax.jit(matrix_factors.orthonormal_columns)(jnp.asarray(columns))
    np.testing.assert_allclose(q.T @ q, np.eye(8), atol=1e-14)
    np.testing.assert_allclose(q @ upper, columns, atol=1e-14)
    assert not np.any(np.tril(upper, -1))


def test_lapack_gets_one_matrix_at_a_time():
    matrices = np.random.default_rng(5).normal(size=(6, 8, 8))

    def largest(matrix):
        return jnp.max(matrix_routines.eigenvalues(matrix).real)

    program = jax.jit(jax.vmap(jax.value_and_grad(largest))).lower(matrices).compile()
    calls = [line for line in program.as_text().splitlines() if "lapack_" in line]
    assert calls and not any("[6,8" in line for line in calls)
    values, slopes = program(matrices)
    np.testing.assert_allclose(values, np.max(np.linalg.eigvals(matrices).real, axis=1), rtol=1e-12)
    step = 1e-6
    moved = np.max(np.linalg.eigvals(matrices + step * np.eye(8)[0][:, None] * np.ones(8)).real, axis=1)
    np.testing.assert_allclose(np.sum(slopes[:, 0], axis=1), (moved - values) / step, atol=1e-4)
    sizes, inverses = jax.vmap(jax.value_and_grad(lambda m: matrix_routines.log_determinant(m)[1]))(matrices)
    np.testing.assert_allclose(sizes, np.linalg.slogdet(matrices)[1], rtol=1e-12)
    np.testing.assert_allclose(inverses, np.swapaxes(np.linalg.inv(matrices), 1, 2), rtol=1e-9)


PREPARING = """
import numpy as np
from fivjax.maps import groups
from fivjax.foundation.precision import in_double_precision
from fivjax.steppers.event_exact import EventExact
from tests.helpers.chains import chain
scene = chain(24, 1)
task = groups.Task(scene, EventExact(), ("mu",), (), {})
run = in_double_precision(groups.constants_of)
print(np.isfinite(run(task, np.linspace(0.1, 0.5, 64)[:, None]).tree.longest_return).all())
"""
MAP = """
import sys
import numpy as np, fivjax as fj
from tests.helpers.chains import chain
n, contacts = map(int, sys.argv[1:])
scene = chain(n, contacts)
common = dict(t_max=0.02, progress=False)
print(fj.bistability_map(scene, mu=[0.2, 0.3], p=np.linspace(2, 40, 3), **common).sizes)
if contacts == 1:
    print(fj.basins(scene, q0=[0.0, 1e-4], dq0=[0.0, 0.1], **common).sizes)
"""


def ended(code: str, *arguments, threads: int, deadline: float) -> str:
    """What a process says that has so many threads in XLA's pool; it is killed at the deadline (s)."""
    variables = os.environ | {
        "NPROC": str(threads),
        "PYTHONPATH": os.pathsep.join([str(PACKAGE.parent), str(ROOT)]),
    }
    command = [sys.executable, "-c", code, *map(str, arguments)]
    ran = subprocess.run(command, env=variables, capture_output=True, text=True, timeout=deadline)
    assert ran.returncode == 0, ran.stderr[-2000:]
    return ran.stdout


@pytest.mark.slow
def test_groups_of_many_coordinates_do_not_wait_for_each_other():
    """What stood still: two calls of LAPACK, each with 64 matrices, in a pool of two threads."""
    assert ended(PREPARING, threads=2, deadline=120) == "True\n"


@pytest.mark.slow
@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize(("n", "contacts"), [(11, 1), (18, 1), (40, 1), (14, 6)])
def test_maps_of_many_coordinates_end(n, contacts, threads):
    assert "mu" in ended(MAP, n, contacts, threads=threads, deadline=600)
