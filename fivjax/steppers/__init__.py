"""How a trajectory is stepped: exactly from event to event, the same in batches, or with the status switched at step ends."""
