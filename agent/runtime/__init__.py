"""Where an agent touches the machine: Zenoh, the real clock, signals, systemd, private folders."""
