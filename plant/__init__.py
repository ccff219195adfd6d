"""Bodies of robots: the contract of a plant, the simulated unicycle, the process that hosts a plant."""
