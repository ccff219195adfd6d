"""A run as a page plays it: its scene, its motion in pieces, its marks in time, its curves, and the page."""
