"""Parameters of a scene from recordings."""
