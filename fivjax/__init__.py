"""fivjax: friction-induced vibration in JAX: slide, stick, detach, squeal; differentiable and in batches."""

import sys

import lazy_loader

from .io.accessor import draw_with as _draw_with

# A name is imported when it is first used, so that `import fivjax` is fast and a map loads no optimiser.
_imported, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name):
    if name != "__version__":
        return _imported(name)
    # Half of the time that `import fivjax` would take.
    from importlib import metadata

    return metadata.version("fivjax")


def _show(dataset, **options):
    from .notebook.display import show

    return show(dataset, **options)


# Lower packages may not import higher ones, so the function that draws datasets and the display in notebooks are set here.
_draw_with(_show)
if "IPython" in sys.modules:
    from .notebook.registration import register as _register

    _register()
