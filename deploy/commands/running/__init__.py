"""Commands to a fleet that is running, here or on its hosts: drive it, order it, stop it, disturb it."""
