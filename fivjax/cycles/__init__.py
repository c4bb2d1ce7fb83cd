"""Limit cycles and saddle cycles of one scene: searched for, described, and next to known ones.

Read first: `cycle`, what a limit cycle is here; `search`, how it is found (by the search of `attractors`). Then
`one_period`, what is seen along it, and `torus` for motions that are quasi-periodic; `saddle`, the cycle between two
attractors; `nearby` and `differentiation`, a cycle as a differentiable function of parameters.
"""
