"""A vehicle as a plant: its estimate, its setpoints, whose it is, what is checked before a drive."""
