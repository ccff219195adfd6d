"""Whether a run was good: oracles and metrics."""
