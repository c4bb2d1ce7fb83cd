"""Compiled code is kept only where nobody else may write; where it cannot be kept, results are the same and a sentence says why."""

import contextlib
import os
import stat
import subprocess
import sys
import warnings
from pathlib import Path

import jax
import pytest

from fivjax.cli import compiled_code
from fivjax.cli.compiled_code import keep_compiled_code
from fivjax.foundation import kept_folder, whole_files
from fivjax.foundation.kept_folder import NotKept, checked, folder_to_keep_in, keep, read_kept


@pytest.fixture(autouse=True)
def nothing_told(monkeypatch):
    monkeypatch.setattr(kept_folder, "_told", set())


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def test_folders_are_made_private_whatever_the_mask(tmp_path):
    before = os.umask(0)
    try:
        assert checked(tmp_path / "cache" / "fivjax").path == tmp_path / "cache" / "fivjax"
        keep(tmp_path / "cache" / "fivjax" / "file", b"content")
    finally:
        os.umask(before)
    assert mode(tmp_path / "cache") == mode(tmp_path / "cache" / "fivjax") == 0o700
    assert mode(tmp_path / "cache" / "fivjax" / "file") == 0o600


@pytest.mark.parametrize("permissions", [0o777, 0o775, 0o1777, 0o702])
def test_a_folder_that_others_may_write_to_is_not_used(tmp_path, permissions):
    folder = tmp_path / "kept"
    folder.mkdir()
    folder.chmod(permissions)
    path, reason = checked(folder)
    assert (
        path is None
        and "may be written to by others" in reason
        and f"{permissions:o}" in reason
        and "chmod 700" in reason
    )
    folder.chmod(0o755)
    assert checked(folder).path == folder


def test_a_folder_or_a_file_of_another_user_is_not_used(tmp_path, monkeypatch):
    keep(tmp_path / "file", b"content")
    assert read_kept(tmp_path / "file") == b"content"
    owner = os.geteuid()
    monkeypatch.setattr(os, "geteuid", lambda: owner + 1)
    assert checked(tmp_path) == (None, "belongs to another user")
    assert read_kept(tmp_path / "file") is None
    monkeypatch.undo()
    keep(tmp_path / "file", b"content")
    (tmp_path / "file").chmod(0o602)
    assert read_kept(tmp_path / "file") is None


def test_a_folder_in_one_that_everybody_may_change_is_not_used(tmp_path):
    (tmp_path / "open" / "kept").mkdir(parents=True)
    tmp_path.chmod(0o755)
    (tmp_path / "open").chmod(0o777)
    # Folders above that nobody else may enter make the rest private.
    parents = [above for above in tmp_path.parents if not above.stat().st_mode & 0o011]
    modes = {above: mode(above) for above in parents}
    try:
        for above in parents:
            above.chmod(modes[above] | 0o011)
        assert f"lies in `{tmp_path / 'open'}`" in checked(tmp_path / "open" / "kept").reason
        (tmp_path / "open").chmod(0o1777)
        assert checked(tmp_path / "open" / "kept").path is not None
        (tmp_path / "open").chmod(0o777)
        tmp_path.chmod(0o700)
        assert checked(tmp_path / "open" / "kept").path is not None
    finally:
        for above, permissions in modes.items():
            above.chmod(permissions)


def test_links_are_followed_to_the_folder_that_is_checked(tmp_path):
    (tmp_path / "far").mkdir()
    (tmp_path / "link").symlink_to("far")
    assert checked(tmp_path / "link" / "kept").path == tmp_path / "far" / "kept"
    (tmp_path / "far").chmod(0o777)
    assert "may be written to by others" in checked(tmp_path / "link").reason


def test_where_nothing_can_be_kept_one_sentence_says_so(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("in the way")
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        for _ in range(3):
            assert folder_to_keep_in(tmp_path / "file" / "kept") is None
        keep(tmp_path / "file" / "kept", b"content")
    (only,) = said
    assert only.category is NotKept and "Not a directory" in str(only.message) and "same" in str(only.message)

    def full(*_):
        raise OSError(28, "No space left on device")

    kept_folder._told.clear()
    keep(tmp_path / "kept", b"before")
    monkeypatch.setattr(whole_files.os, "replace", full)
    with pytest.warns(NotKept, match="No space left on device"):
        keep(tmp_path / "kept", b"after")
    assert read_kept(tmp_path / "kept") == b"before"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "kept"]


@pytest.fixture
def without_cache(monkeypatch):
    """As if JAX had no compilation cache; nothing is set in JAX."""
    found = {}
    monkeypatch.setattr(type(jax.config), "jax_compilation_cache_dir", None, raising=False)
    monkeypatch.setattr(jax.config, "update", found.__setitem__)
    monkeypatch.setattr(warnings, "showwarning", warnings.showwarning)
    monkeypatch.setenv("HOME", "/nowhere/at/all")
    return found


def test_the_command_line_keeps_code_in_a_private_folder_and_removes_what_is_partial(
    tmp_path, monkeypatch, without_cache
):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    folder = tmp_path / "cache" / "fivjax"
    checked(folder)
    for name in ("whole-cache", "whole-atime", "partial-cache"):
        (folder / name).write_bytes(b"12345678")
    keep_compiled_code()
    assert without_cache["jax_compilation_cache_dir"] == str(folder)
    assert {path.name for path in folder.iterdir()} - {".lockfile"} == {"whole-cache", "whole-atime"}


def test_the_command_line_does_without_a_folder(tmp_path, monkeypatch, capsys, without_cache):
    checked(tmp_path / "fivjax")
    (tmp_path / "fivjax").chmod(0o777)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        keep_compiled_code()
        said = capsys.readouterr().err
        kept_folder._told.clear()
        assert said.startswith("fivjax: Compiled code is not kept") and said.count("\n") == 1
        monkeypatch.setenv("XDG_CACHE_HOME", "relative")
        monkeypatch.setattr(Path, "home", classmethod(lambda _: (_ for _ in ()).throw(RuntimeError)))
        keep_compiled_code()
        assert "set XDG_CACHE_HOME" in capsys.readouterr().err
    assert not without_cache


def test_what_jax_says_of_its_cache_is_one_sentence(monkeypatch, capsys):
    monkeypatch.setattr(warnings, "showwarning", compiled_code._show)
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        for name in ("jit_one", "jit_two"):
            warnings.warn(
                f"{compiled_code.NOT_WRITTEN} for '{name}': OSError: [Errno 28] No space left on device", stacklevel=1
            )
            warnings.warn(
                f"{compiled_code.NOT_READ} for '{name}': error: Error -5 while decompressing data", stacklevel=1
            )
    said = capsys.readouterr().err
    assert said.count("\n") == said.count("fivjax: ") == 2 and "No space left on device" in said and "damaged" in said


def test_room_is_made_while_another_process_removes_files(tmp_path, monkeypatch):
    for age, name in enumerate(("new", "gone", "old", "older")):
        (tmp_path / name).write_bytes(b"12345678")
        os.utime(tmp_path / name, (1e9 - age, 1e9 - age))
    listing = os.scandir

    @contextlib.contextmanager
    def listed_before_it_was_removed(folder):
        with listing(folder) as entries:
            entries = list(entries)
        (tmp_path / "gone").unlink()
        yield entries

    monkeypatch.setattr(kept_folder.os, "scandir", listed_before_it_was_removed)
    kept_folder.make_room(tmp_path, 16)
    assert sorted(os.listdir(tmp_path)) == ["new", "old"]


def test_warp_begins_without_a_folder_of_its_own(tmp_path):
    """Its setting stays what it was, and nothing is left behind."""
    pytest.importorskip("warp")
    (tmp_path / "file").write_text("in the way")
    (tmp_path / "temporary").mkdir()
    code = (
        "from fivjax.kernels.warp_library import warp; print(warp().config.kernel_cache_dir, warp().get_device('cpu'))"
    )
    environment = os.environ | {"WARP_CACHE_PATH": str(tmp_path / "file"), "TMPDIR": str(tmp_path / "temporary")}
    run = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=100)
    assert run.returncode == 0 and run.stdout.split()[0].startswith(str(tmp_path / "file"))
    assert not list((tmp_path / "temporary").iterdir())
