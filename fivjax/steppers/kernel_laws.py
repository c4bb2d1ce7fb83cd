"""The laws of contact for kernels: what `contact` and `window` say, written out from their traces."""

import functools
import hashlib
import inspect
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .. import contact as physics
from ..contact import Contact, Mechanics
from ..foundation.kept_programs import kept_value
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
    wp, t = warp(), _types(form)
    like, written = form.mechanics(np.zeros(form.numbers)), kept_value(_written_out, form)
    told = repr((like.free_load.shape, like.tangential, like.normal, *written.values()))

    def body(law):
        source, size = written[law]
        return f"wp::vec_t<{size}, wp::float64> found;\n{source}\nreturn found;"

    @wp.func_native(body("held"))
    def held(mechanics: t.mechanics, mode: t.mode, y: t.state) -> t.state: ...

    @wp.func_native(body("next_mode"))
    def next_mode(mechanics: t.mechanics, mode: t.mode, y: t.state, ending: t.ending) -> t.row: ...

    @wp.func_native(body("has_begun"))
    def has_begun(mode: t.mode, start: t.block, sizes: t.block) -> t.one: ...

    @wp.func_native(body("is_safe"))
    def is_safe(mode: t.mode, start: t.block, hull: t.hull, sizes: t.block) -> t.one: ...

    @wp.func_native(body("brackets"))
    def brackets(mode: t.mode, guards: t.guards, sizes: t.block) -> t.bracket: ...

    @wp.func_native(body("fastest_sample"))
    def fastest_sample(speeds: t.speeds, steps: t.one) -> t.one: ...

    name = hashlib.sha256(told.encode()).hexdigest()[:16]
    return Laws(name, t, like, held, next_mode, has_begun, is_safe, brackets, fastest_sample)


def _types(form: Form) -> Types:
    return types(form.mechanics(np.zeros(form.numbers)).free_load.shape[0], form.numbers)


def _written_out(form: Form) -> dict[str, tuple[str, int]]:
    """The laws in C++, by name: what computes their numbers, and how many these are. Traced in half a second."""
    t = _types(form)

    def contact_of(mode):
        return Contact(mode[0].astype(jnp.int32), mode[1])

    def exact_of(mode):
        return physics.exactly_zero(contact_of(mode))

    def limits_of(sizes):
        return sizes[:6].reshape(3, 2)

    def held(mechanics, mode, y):
        return physics.on_constraint(form.mechanics(mechanics), contact_of(mode), y)

    def next_mode(mechanics, mode, y, ending):
        """`ending`: the load, whether either guard has ended the mode, and the time within which a rebound counts as rest."""
        own, contact = form.mechanics(mechanics), contact_of(mode)
        y = physics.on_constraint(own, contact, y)
        contact, y = physics.transition(own, contact, ending[0], y, ending[1:3] != 0, ending[3])
        return jnp.concatenate([y, jnp.stack([contact.status.astype(y.dtype), contact.direction])])

    def has_begun(mode, start, sizes):
        zeros, _ = leading(start.reshape(4, 2), limits_of(sizes), exact_of(mode))
        return jnp.any(zeros > 0)[None]

    def is_safe(mode, start, hull, sizes):
        hull = hull[: 2 * ORDER].reshape(ORDER, 2)
        return first_is_safe(start.reshape(4, 2), hull, limits_of(sizes), exact_of(mode))

    def brackets(mode, guards, sizes):
        start, end = guards[:10].reshape(5, 2), guards[2 * ORDER + 2 : 2 * ORDER + 4]
        found = bracketed(start, end, limits_of(sizes), exact_of(mode))
        return jnp.concatenate([jnp.ravel(part).astype(start.dtype) for part in jax.tree.leaves(found)])

    def fastest_sample(speeds, steps):
        return fastest(speeds, steps[0])[None]

    kinds = {
        "mechanics": t.mechanics,
        "mode": t.mode,
        "y": t.state,
        "ending": t.ending,
        "start": t.block,
        "hull": t.hull,
        "sizes": t.block,
        "guards": t.guards,
        "speeds": t.speeds,
        "steps": t.one,
    }
    lengths = {name: kind._length_ for name, kind in kinds.items()}
    return {
        law.__name__: scalar_source(law, **{name: lengths[name] for name in inspect.signature(law).parameters})
        for law in (held, next_mode, has_begun, is_safe, brackets, fastest_sample)
    }
