"""A grid of simulated runs over any fields of the fleet file, and its figures."""
