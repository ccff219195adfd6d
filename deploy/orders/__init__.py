"""What an operator orders, and what became of it: missions, stops, resumes (pure)."""
