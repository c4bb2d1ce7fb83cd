"""What measures and compares. Nothing here is collected as a test; `python -m benchmarks` lists it."""
