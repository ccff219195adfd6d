"""The motion of a whole fleet: from a recording (distances, errors, presence), and from the law (stability,
rigidity, forces in balance)."""
