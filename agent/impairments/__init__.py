"""What a bad link does to a message, as netem has it: delay, loss, reordering and more, as pure draws from a
seed."""
