"""A real rover as a plant: ArduPilot Rover over MAVLink."""
