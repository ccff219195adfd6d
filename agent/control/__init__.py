"""The control law in time: constraint forces, prediction of the others, avoidance and the safety filter."""
