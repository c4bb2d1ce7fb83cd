"""Where the command line keeps compiled code from one start to the next."""

import os
from pathlib import Path

# Bytes of compiled code that are kept.
LARGEST = 2**30


def keep_compiled_code() -> None:
    """Keep compiled code, and with it what was traced (`foundation.kept_programs`), in the user's cache folder, unless JAX
    was told where to keep it. What was used longest ago goes first.
    """
    import jax

    if jax.config.jax_compilation_cache_dir is None:
        home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        jax.config.update("jax_compilation_cache_dir", str(Path(home) / "fivjax"))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
        jax.config.update("jax_compilation_cache_max_size", LARGEST)
