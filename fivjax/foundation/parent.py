"""Worker processes end when the process that gave them work is gone: one that was killed cannot tell them."""

import functools
import multiprocessing
import os
import threading
from multiprocessing.connection import wait


@functools.cache
def end_with_parent() -> None:
    """From now on this process ends when its parent does, if `multiprocessing` (or what builds on it) started it.

    Not by the kernel's own means (`PR_SET_PDEATHSIG`), which look at the parent's thread: one that starts workers may end.
    """
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch() -> None:
        wait([parent.sentinel])
        # There is nobody to report to, and nothing that is kept is half written.
        os._exit(1)

    threading.Thread(target=watch, name="fivjax parent", daemon=True).start()
