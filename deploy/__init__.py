"""What an operator runs: the command line, local and virtual-time runs, recordings and reports."""
