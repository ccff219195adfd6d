"""Whether a run was good: oracles, metrics, and an audit of every fate on every link."""
