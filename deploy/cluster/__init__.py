"""Campaigns beyond this machine: runs of a sweep on the workers of a Dask cluster."""
