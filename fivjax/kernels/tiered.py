"""Functions in C++ that are compiled quickly first, and thoroughly once they have run for long (tiered compilation).

Most kernels of a first call run for milliseconds, and compiling them thoroughly takes longer than all else. Both ways have the
same digits (`cpp_fused`), so that no result depends on when the one follows the other.
"""

import threading
import time
from collections.abc import Callable, Sequence

from .c_functions import c_function, is_kept
from .warp_library import compiler_flags

# What is compiled quickly takes a third of the time to compile, and runs four times as long.
QUICKLY, THOROUGHLY = "-O0", "-O3"
# About what it takes to compile thoroughly, in seconds for each character of code.
WORTH = 6e-6


class TieredFunction:
    """A function as `c_function` has it, by source, name and types."""

    def __init__(self, source: str, name: str, types: Sequence, thoroughly: bool = False):
        """`thoroughly`: at once; as is what an earlier process has left."""
        self._told = source, name, types
        self._quick = self._thorough = None
        self._spent, self._making = 0.0, threading.Lock()
        if thoroughly or is_kept(source, compiler_flags(THOROUGHLY)):
            self.compile_thoroughly()
        else:
            self._quick = c_function(*self._told, compiler_flags(QUICKLY))

    def __call__(self, *args) -> None:
        run: Callable | None = self._thorough or self._quick
        assert run is not None
        begin = time.perf_counter()
        run(*args)
        if self._thorough is None:
            self._spent += time.perf_counter() - begin
            if self._spent > WORTH * len(self._told[0]):
                self.compile_thoroughly()

    def compile_thoroughly(self) -> None:
        """Now, if it is not yet. Other threads go on with what there is."""
        with self._making:
            if self._thorough is None:
                self._thorough = c_function(*self._told, compiler_flags(THOROUGHLY))
