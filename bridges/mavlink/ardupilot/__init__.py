"""What is particular to ArduPilot's Rover: constants, frames, the dynamics that were measured (pure)."""
