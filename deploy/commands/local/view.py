"""The command ``handfast view``: a recorded run in the browser."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from agent.common.exit import INTERRUPTED
from deploy.console.arguments import InputError, describe


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what ``handfast view`` takes."""
    describe(
        parser,
        ": robots from above, curves, and what happened, at any moment of it. Serves one page, to this "
        "machine alone, until Ctrl-C.",
    )
    parser.add_argument("folder", metavar="RUN", help="the run's folder")
    parser.add_argument(
        "--port", type=_port, default=0, metavar="N", help="port of the page (default: any that is free)"
    )
    parser.add_argument("--no-browser", dest="browser", action="store_false", help="only print the address")
    parser.set_defaults(command=_view)


def _port(text: str) -> int:
    if not (text.isascii() and text.isdecimal() and 0 < int(text) < 65_536):
        raise argparse.ArgumentTypeError(f"{text!r} is no port: give a number from 1 to 65535")
    return int(text)


def _view(options: argparse.Namespace) -> int:
    import asyncio

    from deploy.playback.page import served_policy
    from deploy.recording.mcap_reader import read_run
    from deploy.verdict.run_result import RunResult
    from deploy.view.browser import open_browser
    from deploy.view.recorded import answers
    from deploy.view.server import Server

    print(f"reading {options.folder}", file=sys.stderr)
    recording = read_run(Path(options.folder))
    for warning in recording.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    answer = answers(RunResult(recording))
    try:
        server = Server(answer, served_policy(), options.port)
    except OSError as error:
        raise InputError(f"--port {options.port}: {error.strerror or error}; leave it out for any") from error
    try:
        print(f"{server.address}  (Ctrl-C ends it)", flush=True)
        if options.browser:
            open_browser(server.address)
        asyncio.run(server.serve())
    except KeyboardInterrupt:
        return INTERRUPTED
    finally:
        server.close()
    return INTERRUPTED
