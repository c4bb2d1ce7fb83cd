"""Kernels are compiled without Warp's Python and kept with digests; what is damaged is built anew, never run; Warp serves where
its compiler is called otherwise than expected.
"""

import ctypes
import importlib.util
import random
import re
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

from fivjax.foundation import kept_folder
from fivjax.foundation.kept_folder import NotKept
from fivjax.kernels import c_functions, cpp_numbers, lane_functions
from fivjax.kernels.lane_functions import LaneFunction

pytest.importorskip("warp")
SOURCE = 'extern "C" void doubled(double* x, int count) { for (int i = 0; i < count; ++i) x[i] *= 2.0; }'
TYPES = (ctypes.c_uint64, ctypes.c_int32)


class Doubling:
    """A function that is loaded as a later process loads it, and how often it was compiled."""

    def __init__(self, monkeypatch):
        self.compiled, self.loads, self.by_digest = 0, 0, {}
        load, build = c_functions._loaded, c_functions._compiled

        def once(own, code, flags, kept):
            """So that many damages take no time."""
            self.compiled += 1
            if code not in self.by_digest:
                self.by_digest[code] = build(own, code, flags, kept)
            list(c_functions._with_room([], None if kept is None else kept.parent))
            return self.by_digest[code]

        def anew(own, compiled, module):
            """Of a name the compiler's library loads one function only."""
            self.loads += 1
            self.name = module + b"_%d" % self.loads
            return load(own, compiled, self.name)

        def lookup(library, name):
            return c_functions.compiler().library.wp_lookup(self.name, name)

        monkeypatch.setattr(c_functions, "_LOADED", set())
        monkeypatch.setattr(c_functions, "_compiled", once)
        monkeypatch.setattr(c_functions, "_loaded", anew)
        monkeypatch.setattr(c_functions, "_address", lambda own, module, name: lookup(own.library, name))

    def in_a_new_process(self) -> list[float]:
        c_functions._LOADED.clear()
        x = np.array([1.0, 2.5])
        c_functions.c_function(SOURCE, "doubled", TYPES, "-O2")(x.ctypes.data, len(x))
        return x.tolist()


@pytest.fixture
def caches(tmp_path, monkeypatch) -> Path:
    """The folder in which compiled code is kept."""
    monkeypatch.setattr(kept_folder, "_told", set())
    monkeypatch.setattr("fivjax.foundation.kept_programs._folder", lambda: str(tmp_path / "cache"))
    monkeypatch.setattr(c_functions.tempfile, "gettempdir", lambda: str(tmp_path / "temporary"))
    (tmp_path / "temporary").mkdir()
    return tmp_path / "cache"


@pytest.fixture
def doubling(caches, monkeypatch) -> Doubling:
    return Doubling(monkeypatch)


def test_a_kernel_is_built_once_and_anew_where_it_is_damaged(doubling, caches):
    for _ in range(2):
        assert doubling.in_a_new_process() == [2.0, 5.0] and doubling.compiled == 1
    (path,) = caches.iterdir()
    content, rng, built = path.read_bytes(), random.Random(0), 1
    damages = [b"", content[: len(content) // 2], None]
    for _ in range(20):
        flipped = bytearray(content)
        flipped[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
        damages.append(bytes(flipped))
    for damaged in damages:
        if damaged is None:
            path.unlink()
        else:
            path.write_bytes(damaged)
        assert doubling.in_a_new_process() == [2.0, 5.0]
        built += 1
        assert doubling.compiled == built and path.read_bytes() == content
    assert not list((caches.parent / "temporary").iterdir())


def test_what_cannot_be_loaded_is_built_anew(doubling, caches, capfd):
    """As on a machine whose loader is another one: the digest is right, and the file is none that the library reads."""
    doubling.in_a_new_process()
    (path,) = caches.iterdir()
    kept_folder.keep(path, b"no object file")
    assert doubling.in_a_new_process() == [2.0, 5.0] and doubling.compiled == 2
    assert "not recognized" in capfd.readouterr().err


def test_a_folder_of_others_or_a_full_disk_costs_time_only(doubling, caches, monkeypatch):
    caches.mkdir()
    caches.chmod(0o777)
    with pytest.warns(NotKept, match="may be written to by others"):
        assert doubling.in_a_new_process() == [2.0, 5.0]
    caches.chmod(0o700)
    kept_folder._told.clear()

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(kept_folder, "write_whole", full)
    with pytest.warns(NotKept, match="No space left on device"):
        assert doubling.in_a_new_process() == [2.0, 5.0]
    assert doubling.compiled == 2 and not list(caches.iterdir())


def test_where_the_disk_is_full_the_compiler_is_not_run(caches, monkeypatch):
    """It would end the process."""

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(c_functions.os, "posix_fallocate", full)
    warnings.simplefilter("ignore", NotKept)
    with pytest.raises(OSError, match=r"no folder has room.*temporary: No space left on device"):
        c_functions.c_function(SOURCE, "doubled", TYPES, "-O1")


def test_code_that_does_not_compile_is_an_error(caches, capfd):
    with pytest.raises(RuntimeError, match="does not compile"):
        c_functions.c_function("no code", "doubled", TYPES, "-O1")
    assert "error" in capfd.readouterr().err and not list(caches.glob("*"))


def test_the_same_code_serves_twice(caches):
    """Kernels of two functions may come to the same code, and a process loads that once."""
    body = "double* x = (double*)xs; x[lane] += 3.0;"
    x = np.zeros(2)
    for _ in range(2):
        LaneFunction(body, ("xs",)).on_cpu(0, 2, x.ctypes.data)
    assert x.tolist() == [6.0, 6.0]


def test_all_functions_that_code_may_call_are_declared():
    called = set(re.findall(r"wp::(\w+)\(", " ".join(cpp_numbers.BY_NUMBER.values())))
    assert len(called) > 15
    assert called <= set(re.findall(r"inline double (\w+)\(", c_functions._declarations()))


@pytest.mark.slow
def test_warp_is_asked_where_its_compiler_is_called_otherwise(monkeypatch, tmp_path):
    """The same lanes, by Warp's own kernels on the CPU."""
    text = (Path(importlib.util.find_spec("warp").origin).parent / "_src" / "context.py").read_text()
    assert c_functions._is_declared(text)
    assert not c_functions._is_declared(text.replace("ctypes.c_size_t,  # size", "ctypes.c_int,  # size"))
    assert not c_functions._is_declared("")
    body = "double* x = (double*)xs; x[lane] = wp::sin(x[lane]) + shift;"
    x = np.linspace(0.0, 3.0, 7)
    found = [x.copy(), x.copy()]
    LaneFunction(body, ("xs",), ("shift",)).in_parts([found[0].ctypes.data, 2], len(x), 3)
    monkeypatch.setattr(lane_functions, "compiler", lambda: None)
    LaneFunction(body, ("xs",), ("shift",)).in_parts([found[1].ctypes.data, 2], len(x), 3)
    np.testing.assert_allclose(found[0], np.sin(x) + 2, rtol=1e-15)
    np.testing.assert_array_equal(*found)


def test_warps_python_is_not_imported_for_kernels():
    code = (
        "import sys, fivjax as fj\n"
        "scene = fj.Scene(fj.belt_oscillator(), fj.Coulomb(0.2), 1.0, fj.Pulse(100.0, 1.5))\n"
        "fj.simulate(scene, 0.1)\n"
        "print('warp' in sys.modules)"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=200)
    assert run.stdout.strip() == "False", run.stderr
