"""What is on the wire: the messages, their bounds, their encoding, and the key expressions they travel on."""
