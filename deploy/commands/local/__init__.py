"""Commands that start what they need on this machine: they make, check, drive, judge and draw."""
