"""JAX functions of one trajectory as functions in C++ for many, and these as a primitive of JAX.

`functions` is what other rooms call. `code` writes a traced function, by the modules `cpp_*`; `kernel` has it compiled and
launches it (`lane_functions`): on a CPU as a function of C (`c_functions`), on GPUs by Warp.
"""
