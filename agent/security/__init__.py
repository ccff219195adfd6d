"""Identities and what each may publish: keys, certificates, access control, signed orders."""
