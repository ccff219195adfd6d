"""What is put on a host: the program, plugins, units of systemd with their sandboxes, a firewall's rules."""
