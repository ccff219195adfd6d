"""Plants that are real vehicles."""
