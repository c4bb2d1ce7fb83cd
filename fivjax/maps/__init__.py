"""Many trajectories, each followed to its verdict: maps, basins, critical kicks, and the cost of accuracy."""
