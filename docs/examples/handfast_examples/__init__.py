"""A plant and two laws of one's own (docs/plugins.md)."""
