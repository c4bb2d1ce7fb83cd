"""A method as text, for the provenance of results."""

from .base import AbstractStepper


def describe_method(method: AbstractStepper) -> str:
    """The method with its inner solver and its step: "WhereSwitched(Tsit5, dt=0.0001)"."""
    inner = getattr(method, "solver", None)
    return f"{type(method).__name__}({'' if inner is None else type(inner).__name__ + ', '}dt={method.dt:g})"
