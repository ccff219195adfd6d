"""Where every robot should be, over time: geometry, slots, trajectory, mission and the reference they
make."""
