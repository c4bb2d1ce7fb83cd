"""The display of results in notebooks, and the explorer."""
