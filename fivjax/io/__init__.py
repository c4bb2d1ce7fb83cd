"""Files: results with units and provenance, structures from finite-element programs, recordings.

Read first: `datasets` and `files`, how a result is labelled, saved and opened; `structure_files`, which calls the readers of
each format. What is read from elsewhere is bounded (`reading_limits`) and, where a library reads it, in a process of its own
(`separate_reading`). `recordings` is what `fj.calibrate` takes.
"""
