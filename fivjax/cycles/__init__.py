"""Limit cycles, computed by Newton's method, with Floquet multipliers; saddle cycles, tori, branches, critical kicks."""
