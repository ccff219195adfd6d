"""Foundations that are not about fleets: time, quantities with units, models of settings, counter-based
random streams."""
