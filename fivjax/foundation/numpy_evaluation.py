"""A traced function computed by NumPy, equation by equation: for small functions of known values.

XLA takes longer to compile such a function than NumPy takes for hundreds of calls. Which equations there are is kept for later
processes (`numpy_plans`), because to trace the function takes longer still than to compute it.
"""

import contextlib
import functools
import json
import math
import sys
import threading
from collections import Counter, OrderedDict
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import jax
import numpy as np

from .argument_forms import Form
from .compiling import compiled, transformed
from .kept_programs import kept, kept_value
from .numpy_plans import NoSuchCase, NumpyPlan, numpy_plan_of
from .plain_trees import NotPlain, from_text, structure_to_text
from .precision import own_settings

# Calls after which it is compiled. To compile the functions that a branch calls repays itself after 700 to 1,600 calls, to
# compile some others after 30 to 200, and many never.
REPAID = 500
# Results that are kept in case they are asked for again: few where they may be large.
LATEST, FEW = 16, 2

P = ParamSpec("P")
R = TypeVar("R")


def by_numpy(function: Callable[P, R], *, always: bool = False, up_to: float = math.inf) -> Callable[P, R]:
    """`compiled`, but the first calls with known values are computed by NumPy; results of all such calls are arrays of NumPy.

    With `always`, so are later calls: where it matters that all are rounded alike. Calls with an array of more than `up_to`
    entries are not: where NumPy's time grows so fast with their number that a single call takes longer than to compile.
    """
    otherwise = compiled(function)

    @functools.cache
    def of_large_arrays() -> Callable[P, R]:
        # Once it can be told whether the function is found by its name. A call of what is kept takes longer to begin.
        return kept(function) if _is_named(call) else otherwise

    plans: dict = {}
    lock = threading.RLock()
    calls: Counter = Counter()
    # The latest results: one call of the library asks for the same of a scene several times.
    latest: OrderedDict = OrderedDict()

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        if transformed((args, kwargs)):
            return otherwise(*args, **kwargs)
        form, arrays = Form.of((args, kwargs))
        key = form, *(np.asarray(array).tobytes() for array in arrays)
        if (found := latest.get(key)) is None:
            if up_to < math.inf and any(array.size > up_to for array in form.arrays):
                return jax.tree.map(_numbers, of_large_arrays()(*args, **kwargs))
            calls[form] += 1
            if calls[form] > REPAID and not always:
                return by_xla(*args, **kwargs)
            try:
                # A result may be a view of an argument.
                latest[key] = found = jax.tree.map(_copied, computed(form, arrays))
            except NoSuchCase:
                return by_xla(*args, **kwargs)
            with contextlib.suppress(KeyError):  # where threads leave out the same
                while len(latest) > (FEW if always else LATEST):
                    latest.popitem(last=False)
        return jax.tree.map(_copied, found)

    def by_xla(*args, **kwargs) -> R:
        with jax.enable_x64(True):
            return jax.tree.map(_numbers, otherwise(*args, **kwargs))

    def computed(form: Form, arrays: list) -> R:
        if form not in plans:
            # Threads that want the same plan wait for the one that makes it.
            with lock:
                if form not in plans:
                    plans[form] = planned(form)
        structure, plan = plans[form]
        given = [np.asarray(leaf, array.dtype) for leaf, array in zip(arrays, form.arrays, strict=True)]
        # As in JAX, what is no number comes without a warning.
        with np.errstate(all="ignore"):
            found = plan(given)
        return jax.tree.unflatten(structure, list(map(_numbers, found)))

    # It is kept by this name.
    @functools.wraps(function)
    def traced(form: Form) -> tuple:
        return _traced(function, form)

    def planned(form: Form) -> tuple:
        structure, plan = kept_value(traced, form) if _is_named(call) else traced(form)
        if isinstance(structure, str):
            structure, plan = from_text(structure), json.loads(plan)
        return structure, NumpyPlan(plan)

    return call


def _numbers(array):
    # Single ones are NumPy's own, which Python's functions take.
    return np.asarray(array)[()]


def _traced(function: Callable, form: Form) -> tuple:
    """The structure of a function's result and the plan by which it is computed: as text, if they can be written as such."""
    structures = []

    def flat(arrays):
        own, named = form.args(arrays)
        leaves, structure = jax.tree.flatten(function(*own, **named))
        structures.append(structure)
        return leaves

    with own_settings():
        plan = numpy_plan_of(jax.make_jaxpr(flat)([jax.ShapeDtypeStruct(*array) for array in form.arrays]))
    try:
        return structure_to_text(structures[-1]), json.dumps(plan)
    except (NotPlain, TypeError):  # of JSON, where an equation is left to JAX
        return structures[-1], plan


def _is_named(call: Callable) -> bool:
    """Whether a function is what its module and name say."""
    found = sys.modules.get(call.__module__)
    for part in call.__qualname__.split("."):
        found = getattr(found, part, None)
    return found is call


def _copied(leaf):
    return leaf.copy() if isinstance(leaf, np.ndarray) else leaf
