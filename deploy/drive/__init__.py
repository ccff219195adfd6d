"""A drive from its preconditions to its end: what `run` and `drive` have in common."""
