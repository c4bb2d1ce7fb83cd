"""Where the command line keeps compiled code from one start to the next."""

import os
from pathlib import Path


def keep_compiled_code() -> None:
    """Keep compiled code in the user's cache folder, unless JAX was told where to keep it."""
    import jax

    if jax.config.jax_compilation_cache_dir is None:
        home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        jax.config.update("jax_compilation_cache_dir", str(Path(home) / "fivjax"))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
