"""The motion of `matrix_motion.cpp` for scenes of one form: with the laws of contact, written out from their traces.

What ends a mode and what follows it is in `contact`; where guards may run out is in `window`.
"""

import functools
import inspect
import math
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .. import contact as physics
from ..contact import Contact, Mechanics, Status
from ..contact.rounding import RESTING
from ..foundation.kept_programs import kept_value
from ..kernels.cpp_code import scalar_source
from .guard_roots import MOST_ROOT_STEPS
from .kernel_matrices import BLOCK, abreast, blocks_of, padded, places_of
from .propagation import INTERVALS, ORDER
from .window import bracketed, fastest, first_is_safe, leading

# The matrices of structures with more degrees of freedom take megabytes for each scene, which are read in every step.
MOST_COORDINATES = 24
# What a vector of `window.Bracket` has of both guards: the guess of the root, then what begins at these places.
BRACKET = {"ZEROS": 2, "ENDS": 4, "CROSSES": 6, "SPENT": 8, "BRACKET": 10}


class MechanicsForm(NamedTuple):
    """What all scenes have in common that one kernel serves: everything in their mechanics but numbers."""

    structure: Any
    shapes: tuple[tuple[int, ...], ...]

    @classmethod
    def of(cls, mechanics: Mechanics, leading: int = 0) -> "MechanicsForm":
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


@functools.cache
def motion_in_cpp(form: MechanicsForm) -> str:
    """The code of `Motion` with all that it refers to."""
    # Terms of the series in the first steps of Newton's method for a root, and how many steps these are.
    short_terms, short_steps = 6, 2
    # Steps for the root of a velocity that changes sign; for where a guard is lowest, and for a peak, from the best of so many
    # points.
    rise_steps, lowest_steps, peak_steps, looks = 12, 6, 5, 8
    like = form.mechanics(np.zeros(form.numbers))
    n, normal = like.free_load.shape[0], like.normal
    at = blocks_of(n)
    whole = {
        "N": n,
        "TANGENTIAL": like.tangential,
        "NUMBERS": form.numbers,
        "INTERVALS": INTERVALS,
        "ORDER": ORDER,
        "BLOCK": BLOCK,
        "COLUMNS": 2 * n + 2,
        "SIDE": abreast(n),
        "SPEED": places_of(n, normal).index(n + like.tangential),
        "OF_SAMPLE": padded(2 * n) // BLOCK,
        "HULL_ROWS": padded(2 * ORDER),
        "GUARD_ROWS": padded(2 * (ORDER + 2)),
        **{
            name.upper(): getattr(at, name) for name in ("hull", "samples", "guards", "displacements", "sizes", "total")
        },
        "STICKING": int(Status.STICK),
        "DETACHED": int(Status.DETACH),
        "MOST_ROOT_STEPS": MOST_ROOT_STEPS,
        "SHORT_STEPS": short_steps,
        "SHORT_TERMS": short_terms,
        "RISE_STEPS": rise_steps,
        "LOWEST_STEPS": lowest_steps,
        "PEAK_STEPS": peak_steps,
        "LOOKS": looks,
        **BRACKET,
    }
    real = {
        "INFINITE": "(1.0 / 0.0)",
        "ROUNDING": repr(8.0 * float(np.finfo(float).eps)),
        "RESTING": repr(RESTING["float64"]),
    }
    lines = [f"enum {{ {', '.join(f'{name} = {value}' for name, value in whole.items())} }};"]
    lines += [f"#define {name} {value}" for name, value in real.items()]
    entries = [f"y[{place}]" if place < 2 * n else ("load", "1.0")[place - 2 * n] for place in places_of(n, normal)]
    filled = " ".join(f"found[{k}] = {entry};" for k, entry in enumerate(entries))
    lines += [
        "struct Laws {",
        f"CUDA_CALLABLE static void row_of(const double* y, double load, double* found) {{ {filled} }}",
    ]
    arguments = _arguments(form)
    for name, (source, size) in kept_value(_laws, form).items():
        told = ", ".join(f"const double* {one}" for one in arguments[name])
        if size == 1:
            lines.append(
                f"CUDA_CALLABLE static double {name}({told}) {{ double found[1];\n{source}\nreturn found[0]; }}"
            )
        else:
            lines.append(f"CUDA_CALLABLE static void {name}({told}, double* found) {{\n{source}\n}}")
    return "\n".join([*lines, "};", (Path(__file__).parent / "matrix_motion.cpp").read_text(encoding="utf-8")])


def _arguments(form: MechanicsForm) -> dict[str, dict[str, int]]:
    """The vectors that each law takes, with their lengths."""
    n = form.mechanics(np.zeros(form.numbers)).free_load.shape[0]
    lengths = {
        "mechanics": form.numbers,
        "mode": 2,
        "y": 2 * n,
        "ending": 4,
        "start": BLOCK,
        "hull": padded(2 * ORDER),
        "sizes": BLOCK,
        "guards": padded(2 * (ORDER + 2)),
        "speeds": INTERVALS + 1,
        "steps": 1,
    }
    laws = _functions(form)
    return {law.__name__: {name: lengths[name] for name in inspect.signature(law).parameters} for law in laws}


def _laws(form: MechanicsForm) -> dict[str, tuple[str, int]]:
    """The laws in C++, by name: what computes their numbers, and how many these are. Traced in half a second."""
    arguments = _arguments(form)
    return {law.__name__: scalar_source(law, **arguments[law.__name__]) for law in _functions(form)}


def _functions(form: MechanicsForm) -> tuple:
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
        """Whether a guard begins at zero."""
        zeros, _ = leading(start.reshape(4, 2), limits_of(sizes), exact_of(mode))
        return jnp.any(zeros > 0)[None]

    def is_safe(mode, start, hull, sizes):
        hull = hull[: 2 * ORDER].reshape(ORDER, 2)
        return first_is_safe(start.reshape(4, 2), hull, limits_of(sizes), exact_of(mode))[None]

    def brackets(mode, guards, sizes):
        start, end = guards[:10].reshape(5, 2), guards[2 * ORDER + 2 : 2 * ORDER + 4]
        found = bracketed(start, end, limits_of(sizes), exact_of(mode))
        return jnp.concatenate([jnp.ravel(part).astype(start.dtype) for part in jax.tree.leaves(found)])

    def fastest_sample(speeds, steps):
        return fastest(speeds, steps[0])[None]

    return held, next_mode, has_begun, is_safe, brackets, fastest_sample
