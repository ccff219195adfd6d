"""Links that fail on purpose: which fault rules hold when, and what they do to each message and tick."""
