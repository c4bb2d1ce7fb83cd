"""Kernels of Warp, kept in a folder of fivjax's own inside Warp's, with digests.

Warp itself takes a file of its cache for what its name says, so a damaged one crashes the process, or computes something else.
Here each kernel has a folder, named by the digest of its code and options and by the processor, with the digests of the files
in it. They are compared before anything is loaded; what is damaged or cannot be loaded is built anew.

Kernels are built in a temporary folder with room to spare, because the compiler ends the whole process where the disk is full.
Neither Warp's own folder nor its settings are changed, so that kernels of others are not affected.
"""

import contextlib
import hashlib
import json
import os
import shutil
import tempfile
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

from .kept_folder import NO_HOME, cannot_keep, folder_to_keep_in, read_own, tell
from .standard_error import silent
from .whole_files import own_folder

# What gives headers by name, or None where there are none.
Headers = Callable[[], dict[str, str] | None]

# The folder inside Warp's, and the file with the digests of a kernel's other files.
FOLDER, DIGESTS = "fivjax", "digests.json"
# The folder inside that for the code of kernels before it is compiled.
TEXTS = "texts"
# Room for building a kernel (bytes): with its headers it needs a third of that.
ROOM = 2**26


def load(wp, module, names: list[str], headers: Headers | None = None) -> None:
    """Load a Warp module on these devices. On a CPU it is compiled with these `headers` in place of Warp's, if given.

    **Raises:** `OSError` where it has to be built and no temporary folder has room.
    """
    folder = _folder(Path(wp.config.kernel_cache_dir))
    missing = [name for name in names if folder is None or not _loaded(wp, module, name, folder)]
    if missing:
        _build_and_load(wp, module, missing, folder, headers)


def folder_of_texts(wp) -> Path | None:
    """The folder for what is told of kernels besides their compiled code."""
    folder = _folder(Path(wp.config.kernel_cache_dir))
    return None if folder is None else folder_to_keep_in(folder / TEXTS)


def _folder(of_warp: Path) -> Path | None:
    if of_warp.is_absolute():
        return folder_to_keep_in(of_warp / FOLDER)
    tell(NO_HOME)
    return None


def _loaded(wp, module, name: str, folder: Path) -> bool:
    """Whether it was among what is kept."""
    with _as_built(wp, module, name):
        place = folder / _key(wp, module, name)
        if not _is_whole(place):
            return False
        try:
            wp.load_aot_module(module, device=name, module_dir=place)
        except Exception:  # whatever Warp raises for what it cannot load
            return False
    return True


def _build_and_load(wp, module, names: list[str], folder: Path | None, headers: Headers | None) -> None:
    failures = []
    for parent in _with_room(failures, folder):
        try:
            for name in names:
                own = headers() if headers is not None and name == "cpu" else None
                if own is None or not _built(wp, module, name, parent, folder, own):
                    _built(wp, module, name, parent, folder)
            return
        except OSError as error:
            failures.append(f"{parent}: {error.strerror or error}")
    raise OSError(f"Kernels cannot be built, because no folder has room for that ({'; '.join(failures)})")


def _built(wp, module, name: str, parent: Path, folder: Path | None, headers: dict[str, str] | None = None) -> bool:
    """Build a kernel for a device, keep it and load it. False where it could not be compiled with these headers."""
    with own_folder(parent) as build, _as_built(wp, module, name):
        place = build / "kernel"
        if headers is not None:
            # Here Warp writes a kernel's code.
            beside = build / f"kernel_p{os.getpid()}_t{threading.get_ident()}"
            beside.mkdir()
            for header, text in headers.items():
                (beside / header).write_text(text, encoding="utf-8")
        try:
            with silent() if headers is not None else contextlib.nullcontext():
                (binary,) = wp.compile_aot_module(module, device=name, module_dir=place)
        except OSError:
            raise
        except Exception:  # whatever Warp raises for what does not compile
            if headers is None:
                raise
            return False
        if folder is not None:
            _keep(folder, _key(wp, module, name), [binary, *binary.parent.glob("*.meta")])
        wp.load_aot_module(module, device=name, module_dir=place)
    return True


def _with_room(failures: list[str], kept: Path | None) -> Iterator[Path]:
    """Folders that have room for building; why others have not is added to the failures."""
    try:
        temporary = [Path(tempfile.gettempdir())]
    except OSError as error:
        temporary = []
        failures.append(str(error.strerror))
    for parent in (*temporary, Path("/dev/shm"), kept):
        if parent is None or not parent.is_dir():
            continue
        try:
            with own_folder(parent) as probe, open(probe / "room", "wb", buffering=0) as file:
                if hasattr(os, "posix_fallocate"):
                    os.posix_fallocate(file.fileno(), 0, ROOM)
                else:
                    file.write(bytes(ROOM))
        except OSError as error:
            failures.append(f"{parent}: {error.strerror or error}")
            continue
        yield parent


def _keep(folder: Path, key: str, files: list[Path]) -> None:
    """Keep these files under a name, all of them or none."""
    place = folder / key
    try:
        with own_folder(folder) as part:
            digests = {}
            for file in files:
                content = file.read_bytes()
                digests[file.name] = hashlib.sha256(content).hexdigest()
                (part / file.name).write_bytes(content)
            (part / DIGESTS).write_text(json.dumps(digests))
            if not _is_whole(place):
                shutil.rmtree(place, ignore_errors=True)
                try:
                    os.rename(part, place)
                except OSError:
                    if not _is_whole(place):  # by another process
                        raise
    except OSError as error:
        cannot_keep(folder, error.strerror or str(error))


def _is_whole(place: Path) -> bool:
    """Whether these are the files that were kept there."""
    try:
        digests = json.loads(read_own(place / DIGESTS))
        return len(digests) > 0 and all(
            hashlib.sha256(read_own(place / name)).hexdigest() == digest for name, digest in digests.items()
        )
    except (OSError, ValueError, AttributeError, TypeError):
        return False


def _key(wp, module, name: str) -> str:
    """The name of what is kept for a device: what is computed, and by which processor."""
    device = wp.get_device(name)
    code = module.get_module_hash(module.options["block_dim"]).hex()
    if device.is_cpu:
        return f"{code}-{wp.get_cpu_kernel_cache_key(cpu_compiler_flags=module.options['cpu_compiler_flags'])}"
    return f"{code}-{wp.config.version}-sm{device.arch}"


@contextlib.contextmanager
def _as_built(wp, module, name: str) -> Iterator[None]:
    """A kernel on a CPU is compiled for blocks of one thread, and that is how it is launched there. To compile Warp's headers
    first would repay from the third kernel of a process that needs them; most have headers of their own.
    """
    if name != "cpu":
        yield
        return
    of_module, of_warp = module.options["block_dim"], wp.config.use_precompiled_headers
    wp.config.use_precompiled_headers, module.options["block_dim"] = False, 1
    # What names a kernel depends on both. Until it is modified again, the module remembers the names of loaded ones.
    module.mark_modified()
    try:
        yield
    finally:
        module.options["block_dim"], wp.config.use_precompiled_headers = of_module, of_warp
