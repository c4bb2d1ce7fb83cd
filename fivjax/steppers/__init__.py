"""How a trajectory is stepped: exactly from event to event, the same in batches, or with the status switched at step ends.

Read first: `base`, what every stepper does; `event_exact`, by Taylor series (`motion_series`, `step_length`,
`law_agreement`) up to the next root of a guard (`guard_roots`); `core`, steps joined to a motion. `where_switched` is the
teaching counterpart; `kernel_scope` says which motions kernels follow.
"""
