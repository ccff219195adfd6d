"""What knows nothing of fleets: time, quantities with units, tables of settings, counter-based random
streams."""
