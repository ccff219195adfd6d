"""Where an agent's process touches the machine but for the bus: the real clock, signals, systemd, folders."""
