"""What all other rooms use, and nothing of friction.

Arguments are checked in `arguments`; `precision` gives double precision to everyone; `kept_programs`, `kept_folder` and
`whole_files` keep what is compiled and what is found; `progress` and `stopping` are for long work, `blocks` for wide
work. Then small linear algebra (`linear_solve`, `matrix_routines`), polynomials and series
(`polynomial`, `taylor`), and functions by NumPy instead of XLA (`numpy_evaluation`).
"""
