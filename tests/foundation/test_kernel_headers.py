"""Kernels are compiled with a few headers of fivjax's own, and with Warp's where those do not serve."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fivjax.foundation import cpp_numbers, kept_kernels, kernel_headers, warp_library
from fivjax.foundation.kernel_functions import KernelFunction

wp = pytest.importorskip("warp")


@pytest.fixture
def compiled_with(monkeypatch, tmp_path):
    """The headers with which kernels are compiled, in a folder where none is kept."""
    seen, built = [], kept_kernels._built

    def seeing(*args):
        seen.append(None if len(args) < 6 else sorted(args[5]))
        return built(*args)

    monkeypatch.setattr(kept_kernels, "_built", seeing)
    monkeypatch.setattr(warp_library.warp().config, "kernel_cache_dir", str(tmp_path))
    return seen


def sines(factor: float) -> np.ndarray:
    """What a kernel that no other test has computes."""

    def function(x, instants):
        return jnp.sin(factor * x), jax.lax.scan(lambda total, t: (total + t, total), jnp.zeros(()), instants)[1]

    found, _ = KernelFunction(function)(np.array([0.5, 2.0]), np.zeros(1), by_kernel=True)
    return np.asarray(found)


def test_a_kernel_is_compiled_with_the_headers_that_it_needs(compiled_with):
    np.testing.assert_allclose(sines(1.25), np.sin([0.625, 2.5]), rtol=1e-15)
    assert compiled_with == [["builtin.h", "deterministic.h"]]


@pytest.mark.parametrize("headers", [None, {"builtin.h": "#error none\n"}])
def test_where_they_do_not_serve_warps_own_do_without_a_word(compiled_with, monkeypatch, capfd, headers):
    monkeypatch.setattr(warp_library, "own_headers", lambda _: headers)
    factor = 1.5 if headers else 1.75
    np.testing.assert_allclose(sines(factor), np.sin([0.5 * factor, 2 * factor]), rtol=1e-15)
    assert compiled_with == ([["builtin.h"], None] if headers else [None])
    assert capfd.readouterr().err == ""


def test_all_functions_that_code_may_call_are_in_them():
    """A name that is missing would not fail: each kernel with it would be compiled with Warp's headers, slowly."""
    called = set(re.findall(r"wp::(\w+)\(", " ".join(cpp_numbers.BY_NUMBER.values())))
    assert len(called) > 15
    text = kernel_headers.own_headers(warp_library.warp())["builtin.h"]
    assert called <= set(re.findall(r"inline double (\w+)\(", text))


def test_a_warp_that_looks_otherwise_keeps_its_own(monkeypatch, tmp_path):
    class Other:
        __file__ = str(tmp_path / "__init__.py")

    assert kernel_headers.own_headers(Other) is None
    (tmp_path / "native").mkdir()
    (tmp_path / "native" / "builtin.h").write_text("struct bounds {};\n")
    assert kernel_headers.own_headers(Other) is None
    assert "launch_bounds_t" in kernel_headers.own_headers(warp_library.warp())["builtin.h"]
