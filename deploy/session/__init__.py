"""An operator on the bus, for as long as one command lasts."""
