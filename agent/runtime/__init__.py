"""Where an agent's process touches the machine: Zenoh, the real clock, signals, systemd, private folders."""
