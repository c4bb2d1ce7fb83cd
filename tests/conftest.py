"""Scenes that many tests share, and what they compile. Nothing here turns double precision on: the library does that for itself."""

import gc
import os
import shutil
import signal
import tempfile
from importlib import metadata

import pytest

import fivjax as fj

CACHE = "JAX_COMPILATION_CACHE_DIR"
FLAGS = "XLA_FLAGS"

# A shell that starts them in the background has them ignore Ctrl-C, and what they start; some of them send it.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Tests run most programs once or twice, so they wait for the compiler and not for what it has compiled. Without LLVM's
# optimisations, and without parts that are compiled side by side, it takes less than half of the time. At this level LLVM would
# choose instructions by a quick way, too (`fast-isel`), which makes wrong programs (`COMPILED_QUICKLY` in `compiling`): by the
# thorough one the results are right. For a run as users compile, set `XLA_FLAGS`, which may be empty.
COMPILED_FOR_TESTS = "--xla_backend_optimization_level=0 --xla_backend_extra_options=-fast-isel=false --xla_cpu_parallel_codegen_split_count=1"
# Later versions have one way only; what XLA does not know ends the process.
if tuple(map(int, metadata.version("jaxlib").split(".")[:2])) < (0, 11):
    COMPILED_FOR_TESTS += " --xla_cpu_use_fusion_emitters=false"

# Files that take longest. They come first: one of them begun last would leave the other workers idle. Those that use what `test_maps`
# compiles come a while after it, or two workers would compile that at the same time.
LONGEST = (
    "maps gradients oracle kernels several_contacts energy cea creeping steppers calibrate one_sided properties contact cycles "
    "kernel_functions calibration_goodness branches tradeoff simulate extending attractor several_sliding verdicts "
    "returns_by_kernels notebooks basins damaged_stores checkpoint smallest_kick kept_programs reproduce standstill design "
    "several_maps proofs_side_by_side nearby_cycle sampling"
)
LONGEST = {f"test_{name}.py": place for place, name in enumerate(LONGEST.split())}


def pytest_configure(config: pytest.Config) -> None:
    """Workers, and the processes that tests start, find compiled what one of them compiled.

    Most of the suite's time is compilation. Workers inherit the folder from the process that starts them, which removes it.
    """
    # What JAX traces is kept, so that looking for rubbish among it at JAX's pace takes a tenth of the time and finds little.
    gc.set_threshold(200_000, 20, 20)
    # There is a worker for each core: threads of BLAS beside it wait for one another more than they work.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Studies of minutes are worth optimising.
    if "not slow" in config.option.markexpr:
        os.environ.setdefault(FLAGS, COMPILED_FOR_TESTS)
    if CACHE not in os.environ:
        os.environ[CACHE] = config.stash[_FOLDER] = tempfile.mkdtemp(prefix="fivjax-compiled-")
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.1")


@pytest.fixture(scope="session", autouse=True)
def _all_kernels_are_quick_at_first():
    """The same holds for kernels: all are compiled quickly until they have run for long."""
    from fivjax.kernels.tiered import QUICKLY
    from fivjax.section.crossings import motion_to_section
    from fivjax.simulation import motion

    motion._by_kernel.level = motion_to_section.level = QUICKLY


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items.sort(key=lambda item: LONGEST.get(item.path.name, len(LONGEST)))


def pytest_unconfigure(config: pytest.Config) -> None:
    if (folder := config.stash.get(_FOLDER, None)) is not None:
        shutil.rmtree(folder, ignore_errors=True)


_FOLDER = pytest.StashKey[str]()


# ------------------------------------------------------------------------------- what the suite compiles, if asked for


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--compiling", action="store_true", help="say in the end how long XLA's compiler worked")


def pytest_sessionstart(session: pytest.Session) -> None:
    """Each process that runs tests notes the seconds of each of XLA's programs; those found compiled count by what it took
    to read them."""
    config = session.config
    if not config.getoption("--compiling"):
        return
    config.stash[_SECONDS] = []
    import jax

    def heard(event: str, duration: float, **about) -> None:
        if event.endswith("backend_compile_duration"):
            config.stash[_SECONDS].append(duration)

    jax.monitoring.register_event_duration_secs_listener(heard)


def pytest_sessionfinish(session: pytest.Session) -> None:
    output = getattr(session.config, "workeroutput", None)
    if output is not None and _SECONDS in session.config.stash:
        output["compiling"] = session.config.stash[_SECONDS]


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node, error) -> None:
    """What a worker has noted comes to the process that started it."""
    if _SECONDS in node.config.stash:
        node.config.stash[_SECONDS] += getattr(node, "workeroutput", {}).get("compiling", [])


def pytest_terminal_summary(terminalreporter, config: pytest.Config) -> None:
    if _SECONDS in config.stash:
        seconds = config.stash[_SECONDS]
        terminalreporter.write_line(
            f"XLA's compiler: {sum(seconds):.0f} s in {len(seconds)} programs, over all workers"
        )


_SECONDS = pytest.StashKey[list]()


@pytest.fixture
def paper_scene() -> fj.Scene:
    """Section 4 of the paper: μ = 0.227, 3 m/s, a kick of 1.2."""
    return fj.Scene(fj.belt_oscillator(), fj.Coulomb(mu=0.227), belt_speed=3.0, load=fj.Pulse(force=100.0, p=1.2))


@pytest.fixture
def compilations() -> list[str]:
    """Has the name of each program that is compiled from now on. JAX's listeners stay for as long as the process lives."""
    # Not above: JAX reads where to keep what is compiled when it is imported.
    import jax

    found: list[str] = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda event, duration, **about: (
            found.append(about.get("fun_name", "")) if event.endswith("backend_compile_duration") else None
        )
    )
    return found
