"""What a fleet takes of its networks, its radios and the machine that it runs on, beside what they have."""
