"""What a recording says of the motion: distances, errors, presence, stability."""
