"""The Poincaré section: its return map, for one scene or many groups, by kernels or XLA."""
