"""What a fleet sends: over its networks and its radios, beside what they have, and in how many processes."""
