"""May it drive, whom may it trust, what was it ordered: the state machine and what feeds it."""
