"""Verdicts on many trajectories: maps and basins; the rounds, jobs, executors and stores that run them."""
