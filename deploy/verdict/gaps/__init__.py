"""Times of which nothing is known: what may have happened then, and what a damaged file hides."""
