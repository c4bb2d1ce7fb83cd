"""The contact mode: what each contact does, and which way friction points while it slides."""

import enum

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, Int


class Status(enum.IntEnum):
    """What a contact does; the codes are the paper's.

    **Example:**

        >>> [status.name for status in fj.Status]
        ['STICK', 'SLIDE', 'DETACH']
    """

    STICK = 0
    SLIDE = 1
    DETACH = 2


class Contact(eqx.Module):
    """The discrete state of the contact: a `Status`, and the direction σ of the friction force while it slides.

    With several contacts both have a last axis over them.
    """

    status: Int[Array, "*batch"]
    direction: Float[Array, "*batch"]

    @classmethod
    def sliding(cls, direction: Float[Array, "*batch"]) -> "Contact":
        """All contacts slide."""
        return cls(np.full(np.shape(direction), Status.SLIDE, np.int32), direction)


def same_mode(status, direction, other_status, other_direction):
    """Which contacts are in the same mode: the direction of friction counts while they slide. For arrays of any kind."""
    return (status == other_status) & ((status != Status.SLIDE) | (direction == other_direction))
