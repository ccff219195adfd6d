"""One robot: the control law, the messages, the fleet file, and the process that runs them."""
