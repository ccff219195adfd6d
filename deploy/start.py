"""Where the command ``handfast`` begins: while what it needs is loaded, Ctrl-C ends it in silence."""

from __future__ import annotations

import signal


def process() -> int:
    """`deploy.cli.process`. Loading it takes a quarter of a second on a slow machine, and an interpreter that
    is interrupted meanwhile would show where it was."""
    is_heeded = signal.getsignal(signal.SIGINT) is signal.default_int_handler  # not so in a job's background
    if is_heeded:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from deploy import cli

    if is_heeded:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    return cli.process()
