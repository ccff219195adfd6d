"""Kinds of scenarios: each module draws the fleet files of one."""
