"""What is simulated: structure, contacts, friction law, load and belt, joined in a scene.

Read first: `scene`; then `structure` and `contact_point`, `friction`, `load` and `belt`. `sliding` is the equilibrium that
motions start from, `directions` are a scene's derivatives by its parameters, `reduction` makes a large structure small,
`matrix_checks` and `structure_checks` refuse what is no structure.
"""
