"""The laws of contact for kernels: what `contact` and `window` say, written out from their traces."""

import functools
import hashlib
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .. import contact as physics
from ..contact import Contact, Mechanics
from ..foundation.scalar_code import scalar_source
from ..foundation.warp_library import warp
from .kernel_types import Types, types
from .propagation import ORDER
from .window import bracketed, fastest, first_is_safe, leading


class Form(NamedTuple):
    """What all scenes have in common that one kernel serves: everything in their mechanics but numbers."""

    structure: Any
    shapes: tuple[tuple[int, ...], ...]

    @classmethod
    def of(cls, mechanics: Mechanics, leading: int = 0) -> "Form":
        """That of mechanics whose numbers have so many leading axes."""
        leaves, structure = jax.tree.flatten(mechanics)
        return cls(structure, tuple(np.shape(leaf)[leading:] for leaf in leaves))

    @property
    def numbers(self) -> int:
        """How many numbers mechanics of this form have."""
        return sum(map(math.prod, self.shapes))

    def mechanics(self, numbers) -> Mechanics:
        """The mechanics with these numbers."""
        ends = np.cumsum([math.prod(shape) for shape in self.shapes]).tolist()
        parts = [
            numbers[end - math.prod(shape) : end].reshape(shape) for shape, end in zip(self.shapes, ends, strict=True)
        ]
        return jax.tree.unflatten(self.structure, parts)


class Laws(NamedTuple):
    """Warp functions for scenes of one form."""

    name: str  # a digest of what the functions do
    types: Types
    mechanics: Mechanics  # of zeros: where tangential and normal coordinates are, and how many there are
    held: Any  # `contact.on_constraint`
    next_mode: Any  # `contact.transition`: the next state, status and direction
    has_begun: Any  # whether a guard begins at zero
    is_safe: Any  # `window.first_is_safe`
    brackets: Any  # `window.bracketed`
    fastest_sample: Any  # `window.fastest`


@functools.cache
def laws(form: Form) -> Laws:
    """The laws for scenes of this form."""
    wp = warp()
    like = form.mechanics(np.zeros(form.numbers))
    t = types(like.free_load.shape[0], form.numbers)
    digest = hashlib.sha256(repr((like.free_load.shape, like.tangential, like.normal)).encode())

    def contact_of(mode):
        return Contact(mode[0].astype(jnp.int32), mode[1])

    def exact_of(mode):
        return physics.exactly_zero(contact_of(mode))[:, None]

    def limits_of(sizes):
        return sizes[:6].reshape(3, 2, 1)

    def holding(mechanics, mode, y):
        return physics.on_constraint(form.mechanics(mechanics), contact_of(mode), y)

    def following(mechanics, mode, y, ending):
        """`ending`: the load, whether either guard has ended the mode, and the time within which a rebound counts as rest."""
        own, contact = form.mechanics(mechanics), contact_of(mode)
        y = physics.on_constraint(own, contact, y)
        contact, y = physics.transition(own, contact, ending[0], y, ending[1:3] != 0, ending[3])
        return jnp.concatenate([y, jnp.stack([contact.status.astype(y.dtype), contact.direction])])

    def beginning(mode, start, sizes):
        zeros, _ = leading(start.reshape(4, 2, 1), limits_of(sizes), exact_of(mode))
        return jnp.any(zeros > 0)[None]

    def safety(mode, start, hull, sizes):
        hull = hull[: 2 * ORDER].reshape(ORDER, 2, 1)
        return first_is_safe(start.reshape(4, 2, 1), hull, limits_of(sizes), exact_of(mode))

    def bracketing(mode, start, end, sizes):
        start, end, inside = start.reshape(5, 2, 1), end.reshape(2, 1), jnp.ones(1, bool)
        found = bracketed(start, end, limits_of(sizes), exact_of(mode), inside)
        return jnp.concatenate([jnp.ravel(part).astype(start.dtype) for part in jax.tree.leaves(found)])

    def peaking(scan, steps):
        return fastest(scan[:-1, None], steps)

    def body(function, **arguments):
        source, size = scalar_source(function, **{name: kind._length_ for name, kind in arguments.items()})
        digest.update(source.encode())
        return f"wp::vec_t<{size}, wp::float64> found;\n{source}\nreturn found;"

    @wp.func_native(body(holding, mechanics=t.mechanics, mode=t.mode, y=t.state))
    def held(mechanics: t.mechanics, mode: t.mode, y: t.state) -> t.state: ...

    @wp.func_native(body(following, mechanics=t.mechanics, mode=t.mode, y=t.state, ending=t.ending))
    def next_mode(mechanics: t.mechanics, mode: t.mode, y: t.state, ending: t.ending) -> t.row: ...

    @wp.func_native(body(beginning, mode=t.mode, start=t.block, sizes=t.block))
    def has_begun(mode: t.mode, start: t.block, sizes: t.block) -> t.one: ...

    @wp.func_native(body(safety, mode=t.mode, start=t.block, hull=t.hull, sizes=t.block))
    def is_safe(mode: t.mode, start: t.block, hull: t.hull, sizes: t.block) -> t.one: ...

    @wp.func_native(body(bracketing, mode=t.mode, start=t.start, end=t.pair, sizes=t.block))
    def brackets(mode: t.mode, start: t.start, end: t.pair, sizes: t.block) -> t.bracket: ...

    @wp.func_native(body(peaking, scan=t.scan, steps=t.one))
    def fastest_sample(scan: t.scan, steps: t.one) -> t.one: ...

    return Laws(digest.hexdigest()[:16], t, like, held, next_mode, has_begun, is_safe, brackets, fastest_sample)
