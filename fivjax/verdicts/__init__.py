"""What can be proved about the end of a trajectory."""
