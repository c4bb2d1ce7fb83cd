"""Functions in C++ that are compiled quickly first, and thoroughly once they have run for long (tiered compilation).

Most kernels of a first call run for milliseconds, and compiling them thoroughly takes longer than all else. Both ways have the
same digits (`cpp_fused`), so that no result depends on when the one follows the other.
"""

import math
import threading
import time
from collections.abc import Callable, Sequence

from .c_functions import c_function, is_kept
from .warp_library import compiler_flags

# Levels of optimisation. What is compiled quickly takes a third of the time to compile, and runs four times as long. Some
# optimisation is for what nearly every call runs for long, and for vectors, as of lanes side by side: these would run fifteen
# times as long without any.
QUICKLY, SOMEWHAT, THOROUGHLY = "-O0", "-O1", "-O3"
# About what it takes to compile thoroughly: seconds for each character of code, and for the square of long code's.
WORTH, WORTH_OF_LONG = 6e-6, 2e-11


class TieredFunction:
    """A function as `c_function` has it, by source, name and types."""

    def __init__(self, source: str, name: str, types: Sequence, level: str = QUICKLY):
        """`level`: the first one, unless an earlier process has left it compiled thoroughly."""
        self._told, self._first_level = (source, name, types), level
        self._at_once = level == THOROUGHLY or is_kept(source, compiler_flags(THOROUGHLY))
        self._run: Callable | None = None
        self._is_thorough = False
        self._spent, self._making = 0.0, threading.Lock()

    def __call__(self, *args) -> None:
        run = self._run or self.compiled()
        begin = time.perf_counter()
        run(*args)
        if not self._is_thorough:
            self._spent += time.perf_counter() - begin
            length = len(self._told[0])
            worth = max(WORTH * length, WORTH_OF_LONG * length**2)
            if self._spent > worth and self._making.acquire(blocking=False):
                # Where it cannot be compiled any more, as on a full disk, it goes on as it is.
                try:
                    self._compile(thoroughly=True)
                except OSError:
                    self._spent = -math.inf
                finally:
                    self._making.release()

    def compiled(self, thoroughly: bool = False) -> Callable:
        """It as it is compiled by now, or `thoroughly`."""
        if self._run is None or (thoroughly and not self._is_thorough):
            with self._making:
                self._compile(thoroughly or self._at_once)
        assert self._run is not None
        return self._run

    def _compile(self, thoroughly: bool) -> None:
        if self._run is None or (thoroughly and not self._is_thorough):
            self._run = c_function(*self._told, compiler_flags(THOROUGHLY if thoroughly else self._first_level))
            self._is_thorough = thoroughly
