"""Where the command ``handfast`` begins: while what it needs is loaded, Ctrl-C ends it in silence."""

from __future__ import annotations

# What `signal` is made of: that loads `enum`, and until then an interrupt would show where it was.
import _signal  # type: ignore[import-not-found]  # there are no stubs of it


def process() -> int:
    """`deploy.cli.process`. Loading it takes a quarter of a second on a slow machine, and an interpreter that
    is interrupted meanwhile would show where it was."""
    sigint = _signal.SIGINT
    is_heeded = _signal.getsignal(sigint) is _signal.default_int_handler  # not so in a job's background
    if is_heeded:
        _signal.signal(sigint, _signal.SIG_DFL)
    from handfast.deploy import cli

    if is_heeded:
        _signal.signal(sigint, _signal.default_int_handler)
    return cli.process()
