"""The control law in time: constraint forces, ways round, who waits for whom, and the safety filter."""
