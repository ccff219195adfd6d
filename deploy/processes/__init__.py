"""The processes of a fleet on this machine: placed on ports, started, watched, ended."""
