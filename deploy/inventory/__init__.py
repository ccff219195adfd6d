"""What there is: hosts and how they are reached, fleets that run on this machine, the certificate
authority."""
