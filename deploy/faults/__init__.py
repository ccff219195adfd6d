"""Fault rules from the operator's side: sent live, and drawn as windows of time."""
