"""What is put on a host: the program, plugins and units of systemd with their sandboxes."""
