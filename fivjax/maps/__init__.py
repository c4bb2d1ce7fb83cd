"""Maps and basins, critical kicks, the cost of accuracy; and the jobs, executors and stores that run them."""
