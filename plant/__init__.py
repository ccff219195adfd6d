"""Bodies of robots: the contract of a plant, the simulated unicycle, and the process that hosts a plant."""
