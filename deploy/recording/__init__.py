"""A run as recorded: writing and reading MCAP, and its messages as columns of numbers."""
