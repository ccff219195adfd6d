"""Commands for a fleet on its own computers: keys and routers that it needs there, and from up to down."""
