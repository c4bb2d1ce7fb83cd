"""The Poincaré section: its return map, for one scene or many groups, by kernels or XLA.

Read first: `return_maps`, the map and its derivative for many states at once. `crossings` follows a motion to the section,
`about_sliding` measures it from steady sliding, `by_kernel` has both done by kernels. `free_directions` says which
deviations the section and a contact mode allow, `peak_speed` how high a motion goes in between. What the section is, is in
`steppers.section`.
"""
