"""How results show themselves in a notebook, and the explorer."""
