"""A run for people: figures, the HTML report, tables to export."""
