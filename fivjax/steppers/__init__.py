"""How a trajectory is stepped: exactly from event to event, in windows, or with the status switched at step ends."""
