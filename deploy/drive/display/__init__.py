"""How a fleet that drives is shown where it is driven from: a table on a terminal, lines elsewhere."""
