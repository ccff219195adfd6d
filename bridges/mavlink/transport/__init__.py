"""Bytes to and from a vehicle: sockets, serial ports, who may open them."""
