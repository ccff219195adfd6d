"""The same agents and plants in virtual time, one run or many side by side."""
