"""Branches of limit cycles over a parameter: folds, changes of mode, grazings, tori beside them.

Read first: `continuation`, what the user calls; `multiple_shooting`, the equations of a cycle with a prescribed sequence of
contact modes; `pseudo_arclength`, the curve of its solutions. `following` goes along it, `verification` looks at the real
motion, `special_points`, `grazing` and `halves` find what is met, `mode_changes` goes on beyond it; `special_derivatives` and
`tori_on_branches` ask more of a branch.
"""
