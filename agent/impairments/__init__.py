"""Impairments of links as netem has them: delay, loss, reordering and more, as pure draws from a seed."""
