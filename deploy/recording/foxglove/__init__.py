"""What Foxglove shows of a fleet, derived from its messages: written beside them, served live, never read
back."""
