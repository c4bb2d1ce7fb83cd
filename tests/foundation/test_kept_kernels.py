"""Kernels are kept with digests: a damaged one is built anew, never run; and Warp's own folder and settings stay as they are."""

import random
import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest

from fivjax.foundation import kept_folder, kept_kernels, warp_library
from fivjax.foundation.kept_folder import NotKept

wp = pytest.importorskip("warp")


class Doubling:
    """A kernel, and how often it was built."""

    def __init__(self, once: Path):
        wp = warp_library.warp()

        @wp.kernel(enable_backward=False, module="unique")
        def doubled(x: wp.array(dtype=wp.float64)):
            x[wp.tid()] = wp.float64(2.0) * x[wp.tid()]

        self.kernel, self.built, self.once, self.compile = doubled, 0, once, wp.compile_aot_module

    def build(self, module, device, module_dir):
        """In place of Warp's: compiled once, then copied, so that many damages take no time."""
        self.built += 1
        if not self.once.exists():
            self.compile(module, device=device, module_dir=self.once)
        shutil.copytree(self.once, module_dir)
        return list(Path(module_dir).glob("*.o"))

    def in_a_new_process(self) -> list[float]:
        """What it computes, once it is loaded as a later process loads it."""
        wp, module = warp_library.warp(), self.kernel.module
        module.unload()
        with warp_library._quietly(wp):
            kept_kernels.load(wp, module, ["cpu"])
        x = np.array([1.0, 2.5])
        wp.launch(self.kernel, dim=2, inputs=[wp.array(x, device="cpu", copy=False)], device="cpu")
        return x.tolist()


@pytest.fixture(scope="module")
def once(tmp_path_factory):
    return tmp_path_factory.mktemp("built") / "kernel"


@pytest.fixture
def doubling(once, tmp_path, monkeypatch):
    wp, found = warp_library.warp(), Doubling(once)
    monkeypatch.setattr(kept_folder, "_told", set())
    monkeypatch.setattr(wp, "compile_aot_module", found.build)
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path / "warp"))
    monkeypatch.setattr(kept_kernels.tempfile, "gettempdir", lambda: str(tmp_path / "temporary"))
    (tmp_path / "temporary").mkdir()
    return found


def kept_in(folder: Path) -> list[Path]:
    return sorted(path for path in (folder / "warp").rglob("*") if path.is_file())


def left_in(folder: Path) -> list[Path]:
    """Temporary files, but for what Warp compiled of its headers: that stays until the process ends."""
    return [path for path in (folder / "temporary").iterdir() if not path.name.startswith("wp_pch_")]


def test_a_kernel_is_built_once_and_anew_where_it_is_damaged(doubling, tmp_path):
    for _ in range(2):
        assert doubling.in_a_new_process() == [2.0, 5.0] and doubling.built == 1
    files = kept_in(tmp_path)
    assert {path.suffix for path in files} == {".json", ".o", ".meta"}
    whole = {path: path.read_bytes() for path in files}
    rng = random.Random(0)
    built = 1
    for path, content in whole.items():
        flips = [rng.randrange(8 * len(content)) for _ in range(8)]
        flipped = [bytearray(content) for _ in flips]
        for damaged, bit in zip(flipped, flips, strict=True):
            damaged[bit // 8] ^= 1 << bit % 8
        for damaged in (b"", content[: len(content) // 2], None, *flipped):
            if damaged is None:
                path.unlink()
            else:
                path.write_bytes(damaged)
            assert doubling.in_a_new_process() == [2.0, 5.0]
            built += 1
            assert doubling.built == built
            path.write_bytes(content)
    assert {path: path.read_bytes() for path in kept_in(tmp_path)} == whole
    assert not left_in(tmp_path)


def test_what_cannot_be_loaded_is_built_anew(doubling, tmp_path):
    """As on a machine whose loader is another one: the digests are right, and the file is none that Warp reads."""
    doubling.in_a_new_process()
    (place,) = (tmp_path / "warp" / "fivjax").iterdir()
    files = {path.name: path.read_bytes() for path in place.iterdir() if path.name != kept_kernels.DIGESTS}
    shutil.rmtree(place)
    for name in files:
        (tmp_path / name).write_bytes(b"" if name.endswith(".o") else files[name])
    kept_kernels._keep(place.parent, place.name, [tmp_path / name for name in files])
    assert doubling.in_a_new_process() == [2.0, 5.0] and doubling.built == 2


def test_kernels_of_others_and_the_settings_of_warp_stay_as_they_are(doubling, tmp_path):
    wp = warp_library.warp()
    before = {name: value for name, value in vars(wp.config).items() if not name.startswith("__")}
    doubling.in_a_new_process()
    assert {name: value for name, value in vars(wp.config).items() if not name.startswith("__")} == before
    assert [path.name for path in (tmp_path / "warp").iterdir()] == ["fivjax"]


def test_a_launch_compiles_nothing_after_a_gpu_has_loaded_the_kernel(doubling, monkeypatch):
    """Of a module that is modified Warp forgets by which settings it was built, and builds it once more."""
    wp = warp_library.warp()
    assert doubling.in_a_new_process() == [2.0, 5.0]
    with kept_kernels._as_built(wp, doubling.kernel.module, "cuda:0"):
        pass

    def anew(*_, **__):
        raise AssertionError("compiled once more")

    monkeypatch.setattr(wp._src.build, "build_cpu", anew)
    x = np.array([1.5])
    wp.launch(doubling.kernel, dim=1, inputs=[wp.array(x, device="cpu", copy=False)], device="cpu")
    assert x.tolist() == [3.0]


def test_a_folder_of_others_or_a_full_disk_costs_time_only(doubling, tmp_path, monkeypatch):
    (tmp_path / "warp" / "fivjax").mkdir(parents=True)
    (tmp_path / "warp" / "fivjax").chmod(0o777)
    with pytest.warns(NotKept, match="may be written to by others"):
        assert doubling.in_a_new_process() == [2.0, 5.0]
    (tmp_path / "warp" / "fivjax").chmod(0o700)
    kept_folder._told.clear()

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(kept_kernels.os, "rename", full)
    with pytest.warns(NotKept, match="No space left on device"):
        assert doubling.in_a_new_process() == [2.0, 5.0]
    assert doubling.built == 2 and not kept_in(tmp_path) and not left_in(tmp_path)
    # Where the folder for temporary files is full, the compiler is not run there: it would end the process.
    monkeypatch.setattr(kept_kernels.os, "posix_fallocate", full)
    warnings.simplefilter("ignore", NotKept)
    with pytest.raises(OSError, match=r"no folder has room.*temporary: No space left on device"):
        doubling.in_a_new_process()
    assert doubling.built == 2
