"""Limit cycles: found, closed by Newton's method, with their Floquet multipliers; the unstable cycle on the boundary; tori."""
