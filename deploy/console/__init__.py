"""What every command line needs: options, exit statuses, Ctrl-C, progress, wording."""
