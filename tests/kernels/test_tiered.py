"""Kernels have the same digits however thoroughly they are compiled, and are compiled thoroughly once that is worth while."""

import ctypes

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fivjax as fj
from fivjax.foundation.argument_forms import Form
from fivjax.kernels import tiered
from fivjax.kernels.c_functions import c_function
from fivjax.kernels.cpp_fused import fused
from fivjax.kernels.functions import KernelFunction
from fivjax.kernels.lane_functions import MANY, LaneFunction
from fivjax.kernels.tiered import TieredFunction
from fivjax.kernels.warp_library import compiler_flags

pytest.importorskip("warp")
SOURCE = 'extern "C" void tripled(double* x) { *x *= 3.0; }'
TYPES = (ctypes.c_uint64,)


@pytest.fixture(autouse=True)
def nothing_kept(monkeypatch):
    monkeypatch.setattr("fivjax.kernels.tiered.is_kept", lambda *_: False)


@pytest.fixture
def levels(monkeypatch) -> list[str]:
    """Those at which functions have been compiled, in order."""
    found = []

    def noted(source, name, types, flags):
        found.append(flags.split()[0])
        return c_function(source, name, types, flags)

    monkeypatch.setattr(tiered, "c_function", noted)
    return found


def tripled(function: TieredFunction) -> float:
    x = np.array([1.5])
    function(x.ctypes.data)
    return float(x[0])


def test_what_has_run_for_long_is_compiled_thoroughly(levels, monkeypatch):
    clock = iter([0.0, 1.0e-9, 2.0, 2.0 + 1.1 * tiered.WORTH * len(SOURCE)])
    monkeypatch.setattr(tiered.time, "perf_counter", lambda: next(clock, 3.0))
    function = TieredFunction(SOURCE, "tripled", TYPES)
    assert tripled(function) == 4.5 and levels == ["-O0"]
    assert tripled(function) == 4.5 and levels == ["-O0", "-O3"]
    assert tripled(function) == 4.5 and levels == ["-O0", "-O3"]


def test_what_is_asked_for_or_kept_is_thorough_at_once(levels, monkeypatch):
    TieredFunction(SOURCE, "tripled", TYPES, tiered.THOROUGHLY).compiled()
    monkeypatch.setattr(tiered, "is_kept", lambda *_: True)
    TieredFunction(SOURCE, "tripled", TYPES).compiled()
    assert levels == ["-O3"] * 2


def test_the_environment_has_the_last_word(levels, monkeypatch):
    monkeypatch.setenv("FIVJAX_KERNEL_FLAGS", "-O1")
    TieredFunction(SOURCE, "tripled", TYPES).compiled(thoroughly=True)
    assert not {"-O0", "-O3"} & set(compiler_flags().split()) and "-O0" not in levels


def test_many_lanes_are_worth_it_at_once(levels):
    body, x = "double* x = (double*)xs; x[lane] += 7.0;", np.zeros(MANY)
    LaneFunction(body, ("xs",)).in_parts([x.ctypes.data], 10, 1)
    assert levels == ["-O0"]
    LaneFunction(body, ("xs",)).in_parts([x.ctypes.data], MANY, 1)
    assert levels == ["-O0", "-O3"] and x.sum() == 7.0 * (MANY + 10)


@pytest.mark.parametrize(
    "friction", [fj.Coulomb(0.227), fj.ExponentialDecay(0.25, 0.2, 0.5)], ids=["constant", "falling"]
)
def test_the_digits_do_not_depend_on_the_level(friction, monkeypatch):
    """A trajectory with its derivatives, where the compiler was free to fuse products with sums."""
    from fivjax.simulation import motion

    scene = fj.Scene(fj.belt_oscillator(), friction, 1.0, fj.Pulse(100.0, 1.2))
    found = {}
    for level in ("-O0", "-O3"):
        monkeypatch.setattr(tiered, "THOROUGHLY", level)
        monkeypatch.setattr(motion, "_by_kernel", motion.KernelFunction(motion._motion, motion._differentiated))
        derivatives = fj.derivatives(lambda run: run.displacement, scene, ["belt_speed"], 0.5, 1e-2)
        found[level] = [derivatives["belt_speed"], fj.simulate(scene, 0.5, 1e-2, energy=True).velocity]
    for quick, thorough in zip(*found.values(), strict=True):
        np.testing.assert_array_equal(quick, thorough)


def test_powers_have_the_same_digits_at_every_level(monkeypatch):
    """A compiler that knows them writes some as products, roots or other powers."""

    def powers(args, instants):
        (x,) = args
        return (x**2.0, jax.lax.pow(x, 0.5), jax.lax.pow(x, -1.0), jnp.exp2(x), jax.lax.pow(4.0, x)), ()

    found, rows = [], np.random.default_rng(1).uniform(0.1, 3.0, size=(5000, 8))
    for level in ("-O0", "-O3"):
        monkeypatch.setenv("FIVJAX_KERNEL_FLAGS", level)
        found.append(KernelFunction(powers).of_many(Form.of((rows[0],))[0], rows)[0])
    for quick, thorough in zip(*found, strict=True):
        np.testing.assert_array_equal(quick, thorough)


def test_where_nothing_more_can_be_compiled_it_goes_on_as_it_is(monkeypatch):
    function, tried = TieredFunction(SOURCE, "tripled", TYPES), []
    assert tripled(function) == 4.5

    def full(*_):
        tried.append(1)
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(tiered, "WORTH", 0.0)
    monkeypatch.setattr(tiered, "WORTH_OF_LONG", 0.0)
    monkeypatch.setattr(tiered, "c_function", full)
    assert [tripled(function) for _ in range(3)] == [4.5] * 3 and len(tried) == 1


def test_products_are_fused_where_nothing_is_written_between():
    lines = [
        "const double v1 = a0[1] * w3;",
        "const double v2 = a0[2] * (0.5);",
        "const double v9 = v1 * v1;",
        "a0[2] = v1;",
        "const double v4 = w3 * given[i7 * 3 + 1];",
        "for (int i5 = 0; i5 < 3; ++i5) {",
        "  const double v6 = w3 * w8;",
        "  a1[i5] = v4 - v6;",
        "}",
        "rotated(a0, a1);",
        "a2[0] = v2 + given[0];",
    ]
    assert fused(lines) == [
        "const double v1 = a0[1] * w3;",
        "const double v2 = a0[2] * (0.5);",
        "a0[2] = v1;",
        "const double v4 = w3 * given[i7 * 3 + 1];",
        "for (int i5 = 0; i5 < 3; ++i5) {",
        "  a1[i5] = v4 - w3 * w8;",
        "}",
        "rotated(a0, a1);",
        "a2[0] = v2 + given[0];",
    ]


def test_products_side_by_side_are_fused():
    lines = ["const reals v1 = (reals)(2.0) * a3[4];", "const reals v2 = v1 + a3[5];", "w6 = v2;"]
    assert fused(lines) == ["const reals v2 = (reals)(2.0) * a3[4] + a3[5];", "w6 = v2;"]
