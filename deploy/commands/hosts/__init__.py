"""Commands that bring a fleet up on its computers and look after it there."""
