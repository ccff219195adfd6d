"""A simulated ArduPilot Rover that speaks MAVLink, to try bridges and ground stations with."""
