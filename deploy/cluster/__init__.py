"""Campaigns beyond this machine: runs of a sweep or of chaos on the workers of a Dask cluster."""
