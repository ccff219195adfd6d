"""One run out of what robots' computers recorded: each is believed about its own robot, and no other."""
