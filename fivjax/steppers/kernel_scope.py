"""Which motions kernels follow."""

import jax

from ..foundation.warp_library import is_installed
from ..model.scene import Scene
from .base import AbstractStepper
from .event_exact import EventExact

# Larger structures and more contacts are left to XLA: their kernels would have more code than they save.
LARGEST, MOST_CONTACTS = 48, 3
PACKAGE = __name__.partition(".")[0]


def has_kernel(scene: Scene, method: AbstractStepper) -> bool:
    """Whether a kernel follows the motions of such scenes by this method.

    Of laws from elsewhere it is not known whether they can be written as C++.
    """
    laws = scene.friction, scene.load, scene.structure
    return (
        isinstance(method, EventExact)
        and is_installed()
        and jax.default_backend() == "cpu"
        and scene.structure.size <= LARGEST
        and len(scene.structure.contacts) <= MOST_CONTACTS
        and all(type(own).__module__.partition(".")[0] == PACKAGE for own in laws)
    )
