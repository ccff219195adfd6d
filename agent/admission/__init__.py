"""Before a robot's ports: who may open a connection now, so that nobody without a
certificate keeps others out."""
