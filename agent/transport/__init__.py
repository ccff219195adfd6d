"""A process's place on the bus over Zenoh: its sessions, the links they consist of, what comes and goes."""
