"""The only room that touches the machine: Zenoh, the real clock, signals, systemd, private folders."""
