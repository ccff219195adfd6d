"""The fleet file: its tables, what is checked across them, and a fleet as its robots read it."""
