"""Many trajectories side by side, in blocks or by kernels: return maps, attractors of groups, rounds to the verdict."""
