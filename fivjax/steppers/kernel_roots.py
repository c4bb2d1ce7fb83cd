"""Roots of guards and of the tangential velocity within an interval: bracketed, then refined by Newton's method."""

from typing import Any, NamedTuple

from ..foundation.warp_library import warp
from .kernel_arithmetic import ROOT_STEPS, Arithmetic
from .kernel_types import Types

MOST_ROOT_STEPS = 60
# Steps of Newton's method in a bracket, for the root of a velocity that changes sign in an interval; bisection is seldom
# needed.
RISE_STEPS = 12
# Steps of Newton's method for where a guard is lowest, and for a peak, from the sample next to it.
LOWEST_STEPS, PEAK_STEPS = 6, 5


class Roots(NamedTuple):
    """Warp functions for polynomials within an interval."""

    lowest_of: Any
    root_of: Any
    rise_of: Any
    highest_of: Any


def roots(t: Types, arithmetic: Arithmetic) -> Roots:
    """The functions for polynomials of these types."""
    wp = warp()
    real, polynomial, pair = wp.float64, t.polynomial, t.pair
    value_at, value_of_few, bent_at = arithmetic.value_at, arithmetic.value_of_few, arithmetic.bent_at
    # Numbers in double precision: Warp takes Python's for single.
    zero, half, one = real(0.0), real(0.5), real(1.0)
    settled, settled_rise = real(1e-7), real(1e-8)
    short_steps = len(ROOT_STEPS) - 1

    @wp.func
    def lowest_of(c: polynomial, guess: real) -> real:
        """Where a guard that dips is lowest, in [0, 1]."""
        x = guess
        for _ in range(LOWEST_STEPS):
            there = bent_at(c, x)
            if there[2] > zero:
                x = x - there[1] / there[2]
            else:
                x = x - there[1]
            x = wp.clamp(x, zero, one)
        return x

    @wp.func
    def root_of(c: polynomial, zeros: real, guess: real, end: real) -> pair:
        """The root in the bracket from 0 to `end`, and the slope there: Newton's method, with bisection where it leads away;
        roots at zero, of which there are `zeros`, do not count.
        """
        low = zero
        high = end
        x = wp.min(guess, end)
        slope = zero
        done = int(0)
        count = int(0)
        while done == 0 and count < MOST_ROOT_STEPS:
            few_terms = count < short_steps
            there = pair()
            if few_terms:
                there = value_of_few(c, x)
            else:
                there = value_at(c, x)
            value = there[0]
            slope = there[1]
            # The slope of the polynomial with its roots at zero divided out, up to the common factor of value and slope.
            if x > zero:
                slope = slope - zeros * value / x
            nearer = x - value
            if slope != zero:
                nearer = x - value / slope
            if few_terms:
                x = wp.clamp(nearer, zero, end)
            else:
                # In its bracket the guard falls through its root.
                if slope < zero and nearer > zero and nearer <= end and wp.abs(nearer - x) <= settled:
                    done = 1
                if value > zero:
                    low = x
                else:
                    high = x
                if done == 0 and not (nearer > low and nearer < high):
                    nearer = half * (low + high)
                x = wp.clamp(nearer, zero, one)
            count += 1
        return pair(x, slope)

    @wp.func
    def rise_of(c: polynomial, end: real, last: real) -> real:
        """Where a velocity rises through zero before `end`, where it is `last`."""
        low = zero
        high = end
        x = end * c[0] / (c[0] - last)
        done = int(0)
        count = int(0)
        while done == 0 and count < RISE_STEPS:
            there = value_at(c, x)
            if there[0] < zero:
                low = x
            else:
                high = x
            slope = there[1]
            if slope == zero:
                slope = one
            nearer = x - there[0] / slope
            if nearer >= low and nearer <= high:
                if wp.abs(nearer - x) <= settled_rise * end:
                    done = 1
                x = nearer
            else:
                x = half * (low + high)
            count += 1
        return x

    @wp.func
    def highest_of(c: polynomial, low: real, high: real) -> real:
        """The largest size of a polynomial near x = 0, for x between `low` and `high`."""
        x = zero
        for _ in range(PEAK_STEPS):
            there = bent_at(c, x)
            bend = there[2]
            if bend == zero:
                bend = one
            x = wp.clamp(x - there[1] / bend, low, high)
        return wp.max(wp.abs(c[0]), wp.abs(value_at(c, x)[0]))

    return Roots(lowest_of, root_of, rise_of, highest_of)
