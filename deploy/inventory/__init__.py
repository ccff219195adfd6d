"""What there is to operate: hosts and how they are reached, fleets that run on this machine or are up, the
certificate authority."""
