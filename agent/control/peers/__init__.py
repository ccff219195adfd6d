"""The other robots: what is known of them, how old that is, where they may be, and where they go."""
