"""What was traced is found by a later process, made anew where it is damaged or out of date, and never trusted by name alone."""

import os
import pickle
import subprocess
import sys
import time
from importlib import metadata
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fivjax as fj
from fivjax.contact import Contact
from fivjax.foundation import kept_folder, kept_programs
from fivjax.foundation.flattened import flatten
from fivjax.foundation.kept_executables import program_from, serialized
from fivjax.foundation.kept_folder import NotKept
from fivjax.foundation.kept_programs import kept, kept_value
from fivjax.foundation.plain_trees import NotPlain, from_text, structure_to_text, to_text


class Counted:
    """A function that counts how often it is traced."""

    def __init__(self):
        self.traced = 0

    def __call__(self, how, y, factor):
        self.traced += 1
        return flatten((Contact(y, y), {"times": factor * y, "sine": jnp.sin(y)}))

    def in_a_new_process(self):
        """As a later process has it: nothing is remembered but what the folder keeps."""

        def traced(*args):
            return self(*args)

        return kept(traced)


@pytest.fixture(autouse=True)
def double_precision():
    with jax.enable_x64(True):
        yield


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(kept_programs, "_folder", lambda: str(tmp_path / "kept"))
    return tmp_path / "kept"


STEPPER = fj.EventExact(order=8)
Y = np.linspace(0.0, 1.0, 5)


def values(result) -> dict[str, np.ndarray]:
    return jax.tree.map(np.asarray, result.tree[1])


def test_a_later_process_finds_what_was_traced_and_computes_the_same_bits(folder):
    function = Counted()
    first = values(function.in_a_new_process()(STEPPER, Y, np.asarray(2.0)))
    assert function.traced == 1 and len(list(folder.iterdir())) == 1
    again = function.in_a_new_process()
    for y in (Y, Y + 1):
        found = values(again(STEPPER, y, np.asarray(2.0)))
    assert function.traced == 1
    np.testing.assert_array_equal(values(again(STEPPER, Y, np.asarray(2.0)))["sine"], first["sine"])
    np.testing.assert_array_equal(found["times"], 2 * (Y + 1))
    again(STEPPER, np.zeros(6), np.asarray(2.0))
    assert function.traced == 2, "another shape is another program"


@pytest.mark.parametrize("damage", [b"", b"nothing", "cut", "changed"])
def test_a_damaged_file_is_made_anew(folder, damage):
    function = Counted()
    function.in_a_new_process()(2.0, Y, np.asarray(3.0))
    (path,) = folder.iterdir()
    whole = path.read_bytes()
    path.write_bytes({"cut": whole[: len(whole) // 2], "changed": whole[:-9] + bytes(9)}.get(damage, damage))
    found = values(function.in_a_new_process()(2.0, Y, np.asarray(3.0)))
    assert function.traced == 2
    np.testing.assert_array_equal(found["times"], 3 * Y)
    function.in_a_new_process()(2.0, Y, np.asarray(3.0))
    assert function.traced == 2 and list(folder.iterdir()) == [path], "and kept again"


def test_other_source_and_other_arguments_are_other_programs(folder, monkeypatch):
    function = Counted()
    for how in (2.0, 3.0):
        function.in_a_new_process()(how, Y, np.asarray(1.0))
    assert function.traced == 2
    monkeypatch.setattr(kept_programs, "_source", lambda: "another")
    function.in_a_new_process()(2.0, Y, np.asarray(1.0))
    assert function.traced == 3 and len(list(folder.iterdir())) == 3


def test_source_that_was_changed_after_its_import_keeps_nothing_for_others(monkeypatch):
    """A process goes on with the source that it has imported, whatever an installation has put there meanwhile."""
    digest = kept_programs._source.__wrapped__
    assert digest() == digest()
    (name, time, size), *others = kept_programs.IMPORTED
    monkeypatch.setattr(kept_programs, "IMPORTED", [(name, time - 1, size), *others])
    assert digest() != digest()


def test_what_a_user_wrote_is_traced_each_time(folder):
    """Its name stays when its text changes: a friction law of one's own must not be another one's."""

    class Own(eqx.Module):
        strength: float = 0.3

    function = Counted()
    for _ in range(2):
        found = function.in_a_new_process()(Own(), Y, np.asarray(4.0))
        np.testing.assert_array_equal(values(found)["times"], 4 * Y)
    assert function.traced == 2 and not folder.exists()


def test_the_folder_stays_small_and_what_was_used_last_stays(folder, monkeypatch):
    function = Counted()
    function.in_a_new_process()(1.0, Y, np.asarray(1.0))
    (first,) = folder.iterdir()
    monkeypatch.setattr(kept_programs, "LARGEST", int(2.5 * first.stat().st_size))
    for how in (2.0, 1.0, 3.0):
        time.sleep(0.05)  # file systems tell times apart by a few milliseconds
        function.in_a_new_process()(how, Y, np.asarray(1.0))
    assert first in list(folder.iterdir()) and len(list(folder.iterdir())) == 2


def test_a_folder_that_cannot_be_made_is_done_without(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setattr(kept_programs, "_folder", lambda: str(tmp_path / "file" / "kept"))
    with pytest.warns(NotKept, match="cannot be made: Not a directory"):
        found = values(Counted().in_a_new_process()(1.0, Y, np.asarray(5.0)))
    np.testing.assert_array_equal(found["times"], 5 * Y)


def test_the_name_covers_every_library_whose_code_may_be_in_a_program(folder, monkeypatch):
    for library in ("jax", "jaxlib", "equinox", "diffrax", "optimistix", "lineax", "numpy", "warp-lang"):
        assert f"{library} {metadata.version(library)}" in kept_programs._versions()
    function = Counted()
    function.in_a_new_process()(2.0, Y, np.asarray(1.0))
    monkeypatch.setattr(kept_programs, "_versions", lambda: ["diffrax 0"])
    function.in_a_new_process()(2.0, Y, np.asarray(1.0))
    assert function.traced == 2 and len(list(folder.iterdir())) == 2


class Calls:
    """Unpickled, it makes a folder."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


def test_no_file_is_unpickled_whatever_its_digest(folder, tmp_path):
    function, made = Counted(), []

    def squares(numbers):
        made.append(numbers)
        return {number: number**2 for number in numbers}

    for _ in range(2):
        function.in_a_new_process()(2.0, Y, np.asarray(3.0))
        assert kept_value(squares, (2, 3)) == {2: 4, 3: 9}
        for path in folder.iterdir():
            kept_folder.keep(path, pickle.dumps(Calls(tmp_path / "called")))
    assert function.traced == 2 and len(made) == 2 and not (tmp_path / "called").exists()


@pytest.mark.parametrize("text", ['{"class": "os:system", "fields": {"dict": []}}', '{"class": "fivjax.io.files:os", "fields": 1}',
                                  '{"class": "fivjax:Scene", "fields": {"dict": [["other", 1]]}}', '{"function": "eval"}', "[1]",
                                  '{"class": "fivjax.none:Scene", "fields": {"dict": []}}', "{", "["*9999])  # fmt: skip
def test_text_that_names_anything_but_plain_parts_is_none(text):
    with pytest.raises((NotPlain, ValueError, RecursionError)):
        from_text(text)


def test_plain_values_come_back():
    plain = {"several": (2.5, None, [True, "text\0"]), "infinite": float("inf"), "named": {1: "one"}}
    assert from_text(to_text(plain)) == plain
    structure = jax.tree.structure({**plain, "law": fj.Coulomb(0.25, 0.5), "flat": flatten(Contact(Y, Y))})
    assert from_text(structure_to_text(structure)) == structure
    with pytest.raises(NotPlain):
        to_text(np.zeros(2))
    with pytest.raises(NotPlain):
        structure_to_text(jax.tree.structure(eqx.nn.Identity()))


def test_no_flipped_bit_is_read(tmp_path):
    path = tmp_path / "kept"
    kept_folder.keep(path, b"some program")
    whole = path.read_bytes()
    for bit in range(8 * len(whole)):
        path.write_bytes((int.from_bytes(whole, "big") ^ (1 << bit)).to_bytes(len(whole), "big"))
        assert kept_folder.read_kept(path) is None and not path.exists(), "and is removed"
    for length in range(len(whole)):
        path.write_bytes(whole[:length])
        assert kept_folder.read_kept(path) is None


def test_under_a_transformation_it_is_part_of_what_the_caller_compiles(folder):
    function = Counted()
    slope = jax.jacfwd(lambda y: function.in_a_new_process()(1.0, y, jnp.asarray(2.0)).tree[1]["times"])(jnp.ones(2))
    np.testing.assert_array_equal(slope, 2 * np.eye(2))
    assert not folder.exists()


def test_a_value_is_made_once_and_anew_where_its_file_is_damaged(folder):
    made = []

    def squares(numbers):
        made.append(numbers)
        return {number: number**2 for number in numbers}

    for _ in range(2):
        assert kept_value(squares, (2, 3)) == {2: 4, 3: 9}
    assert made == [(2, 3)]
    assert kept_value(squares, (4,)) == {4: 16} and len(made) == 2
    for path in folder.iterdir():
        path.write_bytes(b"damaged")
    assert kept_value(squares, (2, 3)) == {2: 4, 3: 9} and len(made) == 3


def test_a_value_of_what_a_user_wrote_is_made_each_time(folder):
    class Own(NamedTuple):
        strength: float

    made = []
    for _ in range(2):
        assert kept_value(lambda law: made.append(law) or law.strength, Own(0.3)) == 0.3
    assert len(made) == 2 and not folder.exists()


def test_a_program_from_its_bytes_runs_inside_a_caller_s_derivative():
    """Where a rule for derivatives computes known values by it, as that of the critical friction of a large structure."""
    lowered = jax.jit(lambda x: (x[0] * x[1], x[::-1]), keep_unused=True).lower(jnp.ones(2))
    program = program_from(serialized(lowered, lowered.compile()))

    @jax.custom_jvp
    def product(x):
        return program([x])[0]

    @product.defjvp
    def rule(primals, tangents):
        value, slopes = program([np.asarray(primals[0])])
        return value, slopes @ tangents[0]

    assert jax.grad(product)(jnp.array([2.0, 3.0])).tolist() == [3.0, 2.0]


IN_A_NEW_PROCESS = """
import jax, numpy as np
import jax._src.compiler as compiler
compiled, before = [], compiler.compile_or_get_cached
def counted(backend, computation, *args, **options):
    compiled.append(str(computation.operation.attributes["sym_name"]))
    return before(backend, computation, *args, **options)
compiler.compile_or_get_cached = counted
import fivjax as fj
found = fj.cea.eigenvalues(fj.belt_oscillator(), np.array([0.1, 0.2]))
print(repr(found.ravel().tolist()), sum("eigenvalues" in name or "of_arrays" in name for name in compiled))
"""


def test_a_library_s_user_finds_compiled_programs_again_unless_told_otherwise(tmp_path):
    """Without a compilation cache of JAX's, and with LAPACK in the program: the same bits, compiled once."""
    found = []
    for more in ({}, {}, {"FIVJAX_KEEP_PROGRAMS": "0"}):
        env = {**os.environ, "XDG_CACHE_HOME": str(tmp_path), **more}
        env.pop("JAX_COMPILATION_CACHE_DIR", None)
        run = subprocess.run([sys.executable, "-c", IN_A_NEW_PROCESS], env=env, capture_output=True, text=True)
        assert run.returncode == 0, run.stderr
        found.append(run.stdout.split("]"))
    assert found[0][0] == found[1][0] == found[2][0]
    assert [int(count) for _, count in found] == [1, 0, 1]
    assert list((tmp_path / "fivjax").rglob("_eigenvalues_over-*"))


def test_a_program_that_calls_python_is_not_kept_as_compiled(folder):
    """A callback is an address in this process."""

    def doubled(y):
        return jax.pure_callback(lambda y: 2 * y, jax.ShapeDtypeStruct(y.shape, y.dtype), y)

    np.testing.assert_array_equal(kept(doubled)(Y), 2 * Y)
    assert not any(kept_programs.EXECUTABLE in path.read_bytes() for path in folder.glob("*"))


def test_a_program_that_does_not_run_is_compiled_anew(folder, monkeypatch):
    """As one whose code is not whole, which JAX tells where it runs."""

    def failing(content):
        def run(arrays):
            raise jax.errors.JaxRuntimeError("NOT_FOUND: a function")

        return run

    function = Counted()
    first = values(function.in_a_new_process()(1.0, Y, np.asarray(2.0)))
    monkeypatch.setattr(kept_programs, "program_from", failing)
    if not jax.config.jax_compilation_cache_dir:
        assert kept_programs.EXECUTABLE in next(folder.iterdir()).read_bytes()
    found = values(function.in_a_new_process()(1.0, Y, np.asarray(2.0)))
    np.testing.assert_array_equal(found["sine"], first["sine"])
