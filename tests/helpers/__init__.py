"""What tests and benchmarks share: references that share no code with the package, scenes, recordings, refusals."""
