"""The folder in which the command line keeps compiled code for later runs."""

import os
from pathlib import Path

# The largest size of the compiled code that is kept, in bytes.
LARGEST = 2**30


def keep_compiled_code() -> None:
    """Keep compiled code, and traced programs (`foundation.kept_programs`), in the user's cache folder, unless JAX has a
    compilation cache already. What was used longest ago is removed first.
    """
    import jax

    if jax.config.jax_compilation_cache_dir is None:
        home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        jax.config.update("jax_compilation_cache_dir", str(Path(home) / "fivjax"))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
        jax.config.update("jax_compilation_cache_max_size", LARGEST)
