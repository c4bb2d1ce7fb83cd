"""fivjax: friction-induced vibration in JAX: slide, stick, detach, squeal; differentiable and in batches."""

from importlib import metadata

import lazy_loader

# A name is imported when it is first used: `import fivjax` costs nothing, and a map loads no optimiser.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

__version__ = metadata.version("fivjax")
