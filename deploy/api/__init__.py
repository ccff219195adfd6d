"""What `import handfast` offers whoever drives fleets: load, check, simulate, run and sweep, from Python."""
