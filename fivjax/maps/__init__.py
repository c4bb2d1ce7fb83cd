"""Many trajectories, each followed to its verdict: maps, critical kicks, what accuracy costs."""
