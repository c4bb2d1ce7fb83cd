"""The boundary between sliding and squeal: critical kicks, smallest kicks, the stable manifold, grazing kicks.

Read first: `critical`, the kick that is just enough, by verdicts, and `narrowing`, its scan and brackets; `stable_manifold` and
`touching`, the same by Newton's method on the two kinds of boundary, with derivatives; `response`, the motion after a kick.
`smallest` and `smallest_perturbation` vary the kick's shape, `boundary_plane` draws the boundary, `tradeoff_study` measures
what accuracy costs.
"""
