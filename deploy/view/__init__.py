"""The server of the page that shows a run: HTTP on the loopback interface."""
