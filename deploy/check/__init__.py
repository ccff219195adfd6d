"""What a fleet file will do and what is wrong with it, before anything moves."""
