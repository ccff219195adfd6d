"""Fault rules from the operator's side: sent live, drawn as windows of time, replayed from a recording."""
