"""Commands that need nothing but this machine: they make, check, drive, judge and draw."""
