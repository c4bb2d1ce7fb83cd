"""Processes: forked ones, workers whose parent is gone, and how the program ends when it is told to."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import fivjax as fj
from fivjax.cli.ending import PATIENCE

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="a POSIX system")
VARIABLES = os.environ | {"PYTHONPATH": str(Path(fj.__file__).parents[1])}

FORKED = """
import os, sys, warnings
import fivjax as fj
warnings.simplefilter("ignore")
def child(work):
    sys.stdout.flush()
    if os.fork():
        return os.waitstatus_to_exitcode(os.wait()[1])
    try:
        work()
        os._exit(0)
    except RuntimeError as error:
        print(error, flush=True)
        os._exit(3)
compute = lambda: fj.painleve_friction(fj.belt_oscillator())
print(child(compute))
compute()
print(child(compute), child(lambda: fj.simulate(None, 0.1)), child(lambda: fj.Coulomb(mu=0.2)))
"""


def test_a_forked_process_is_told():
    """One that is forked before JAX has computed anything is able to compute; any other would wait for ever."""
    ran = subprocess.run([sys.executable, "-c", FORKED], env=VARIABLES, capture_output=True, text=True, timeout=120)
    first, *refused, last = ran.stdout.splitlines()
    assert (first, last) == ("0", "3 3 3"), ran.stderr
    assert len(refused) == 3 and all('get_context("spawn")' in said and "forkserver" in said for said in refused)


ORPHANED = """
import multiprocessing, os, sys, time
from concurrent.futures import ProcessPoolExecutor
from fivjax.foundation.parent import end_with_parent
if __name__ == "__main__":
    pool = ProcessPoolExecutor(1, mp_context=multiprocessing.get_context(sys.argv[1]), initializer=end_with_parent)
    print(pool.submit(os.getpid).result(), flush=True)
    time.sleep(100)
"""


def is_running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.skipif(not Path("/proc").exists(), reason="needs /proc")
@pytest.mark.parametrize("start", ["spawn", "forkserver"])
def test_workers_end_with_their_parent(tmp_path, start):
    script = tmp_path / "pool.py"
    script.write_text(ORPHANED)
    parent = subprocess.Popen([sys.executable, script, start], env=VARIABLES, stdout=subprocess.PIPE, text=True)
    worker = int(parent.stdout.readline())
    parent.kill()
    parent.wait()
    parent.stdout.close()
    end = time.monotonic() + 20
    while is_running(worker) and time.monotonic() < end:
        time.sleep(0.05)
    assert not is_running(worker)


BUSY = """
import hashlib, time
import fivjax.cli.command_line as command_line
from fivjax.cli import program
class Busy:
    def run(self):
        print("begun", flush=True)
        {work}
command_line.keep_compiled_code = lambda: None
command_line.tyro.extras.subcommand_cli_from_dict = lambda *_, **__: Busy()
program()
"""
# Python waits; compiled code runs, which lets Python handle no signal.
WAITS, IN_COMPILED_CODE = "time.sleep(60)", "hashlib.pbkdf2_hmac('sha256', b'', b'', 10**9)"


@pytest.fixture
def heeded():
    """Processes heed Ctrl-C, which those that a shell starts in the background do not, nor what they start."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@contextlib.contextmanager
def begun(code: str, **about):
    """A process that runs this and has said that it has begun; whatever comes, it is gone in the end."""
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", code], env=VARIABLES, **pipes, **about) as running:
        try:
            assert running.stdout.readline() == "begun\n"
            yield running
        finally:
            running.kill()


@pytest.mark.usefixtures("heeded")
@pytest.mark.parametrize(("work", "number"), [(WAITS, signal.SIGTERM), (IN_COMPILED_CODE, signal.SIGINT)])
def test_a_signal_ends_a_command_wherever_it_is(work, number):
    with begun(BUSY.format(work=work)) as running:
        began = time.monotonic()
        running.send_signal(number)
        _, said = running.communicate(timeout=30)
    assert running.returncode == 128 + number
    assert time.monotonic() - began < PATIENCE + 3
    assert said.startswith("fivjax: Interrupted") and "Traceback" not in said


IMPORTING = """
import sys
class Slow:
    def find_spec(self, name, *_):
        if name == {module!r}:
            import time
            print("begun", flush=True)
            try:
                time.sleep(30)
            except BaseException:  # as some packages have it
                pass
sys.meta_path.insert(0, Slow())
sys.argv = ["fivjax", "cea"]
from fivjax.cli import program
program()
"""


@pytest.mark.usefixtures("heeded")
@pytest.mark.parametrize(("module", "number"), [("tyro", signal.SIGTERM), ("fivjax.linear.critical", signal.SIGINT)])
def test_a_signal_ends_a_command_during_imports(tmp_path, module, number):
    """Before a command is known, and within it."""
    with begun(IMPORTING.format(module=module), cwd=tmp_path) as running:
        running.send_signal(number)
        _, said = running.communicate(timeout=30)
    assert running.returncode == 128 + number
    assert said.startswith("fivjax: Interrupted") and "Traceback" not in said and said.count("\n") == 1


@pytest.mark.slow
@pytest.mark.usefixtures("heeded")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("after", [3.0, 8.0, 15.0, 25.0])
@pytest.mark.parametrize("workers", ["0", "2"])
def test_a_signal_ends_a_map(tmp_path, number, after, workers):
    command = [sys.executable, "-m", "fivjax", "map", "--x", "mu=0.1:0.228:1600", "--y", "p=1:4:1600"]
    running = subprocess.Popen(
        [*command, "--workers", workers], env=VARIABLES, cwd=tmp_path, stderr=subprocess.PIPE, text=True
    )
    time.sleep(after)
    began = time.monotonic()
    running.send_signal(number)
    running.wait(30)
    assert time.monotonic() - began < 6
    assert running.returncode == 128 + number
    assert "Traceback" not in running.stderr.read()
    running.stderr.close()
