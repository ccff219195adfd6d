"""The command ``handfast view``: a recorded run or a running fleet in the browser."""

from __future__ import annotations

import argparse
import errno
import select
import sys
from collections.abc import Coroutine
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from handfast.agent.common.errors import INTERRUPTED
from handfast.agent.fleet.model import FleetError
from handfast.deploy.console.arguments import InputError, describe
from handfast.deploy.console.interrupt import as_python_does
from handfast.deploy.inventory.known_fleets import NoAnswerError, handled
from handfast.deploy.recording.run_files import RECORDING_FILE

if TYPE_CHECKING:
    from handfast.deploy.view.live import LiveServer
    from handfast.deploy.view.server import Answer

RETRY_S: Final = 0.2
FOXGLOVE_PORT: Final = 8765
"""Where Foxglove looks for a server unless it is told another port."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what ``handfast view`` takes."""
    describe(
        parser,
        ": robots from above, curves, and what happened; of a run at any moment of it, of a fleet as it is "
        "now, with a STOP and what else can be ordered. Serves one page, to this machine alone unless told "
        "otherwise, until Ctrl-C, which changes nothing for the robots.",
    )
    parser.add_argument(
        "what", metavar="RUN|FLEET", help="folder of a run that is over; or a fleet that is running"
    )
    parser.add_argument(
        "--port", type=_port, default=0, metavar="N", help="port of the page (default: any that is free)"
    )
    parser.add_argument("--no-browser", dest="browser", action="store_false", help="only print the address")
    parser.add_argument(
        "--listen",
        metavar="ADDRESS",
        help="of a secured fleet: serve browsers of other machines as well, which reach this one by ADDRESS, "
        "with a certificate of the fleet's authority",
    )
    parser.add_argument(
        "--read-only", action="store_true", help="of a fleet: nothing can be ordered on the page"
    )
    parser.add_argument(
        "--foxglove",
        type=_port,
        nargs="?",
        const=FOXGLOVE_PORT,
        metavar="N",
        help=f"of a fleet: serve it to Foxglove on this machine as well, on port N ({FOXGLOVE_PORT})",
    )
    parser.add_argument("--beside", action="store_true", help=argparse.SUPPRESS)  # `handfast run --view`
    parser.set_defaults(command=handled(_view))


def _port(text: str) -> int:
    if not (text.isascii() and text.isdecimal() and 0 < int(text) < 65_536):
        raise argparse.ArgumentTypeError(f"{text!r} is no port: give a number from 1 to 65535")
    return int(text)


def _view(options: argparse.Namespace) -> int:
    if options.beside:
        return _started(options)
    from handfast.deploy.inventory.known_fleets import is_driven

    folder = Path(options.what)
    if not folder.is_dir() or is_driven(folder) or _is_fleet(options.what):
        return _live(options)
    given = {
        "--listen": options.listen is not None,
        "--read-only": options.read_only,
        "--foxglove": options.foxglove is not None,
    }
    for option in (name for name, is_given in given.items() if is_given):
        raise InputError(f"{option} is for fleets that run: {folder} is the folder of a run that is over")
    return _recorded(options, folder)


def _is_fleet(what: str) -> bool:
    """Whether it is the name of a fleet, which a folder happens to have too."""
    from handfast.deploy.console.data_files import FLEETS, bundled
    from handfast.deploy.inventory.known_fleets import known

    return not (Path(what) / RECORDING_FILE).exists() and (what in bundled(FLEETS) or bool(known(what)))


def _recorded(options: argparse.Namespace, folder: Path) -> int:
    from handfast.deploy.playback.page import served_policy
    from handfast.deploy.recording.mcap_reader import read_run
    from handfast.deploy.verdict.run_result import RunResult
    from handfast.deploy.view.recorded import answers
    from handfast.deploy.view.server import Server

    print(f"reading {options.what}", file=sys.stderr)
    recording = read_run(folder)
    for warning in recording.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    answer = answers(RunResult(recording))
    try:
        server = Server(answer, served_policy(), options.port)
    except OSError as error:
        raise _taken(options, error) from error
    try:
        return _serve(options, server.address, server.serve())
    finally:
        server.close()


def _live(options: argparse.Namespace) -> int:
    from handfast.agent.formation.geometry import resolved
    from handfast.deploy.commands.running.ways import ways
    from handfast.deploy.inventory.known_fleets import as_running, find
    from handfast.deploy.session.operator_bus import operator_bus
    from handfast.deploy.session.session import Session, connected
    from handfast.deploy.view.live import LiveServer
    from handfast.deploy.view.server import LOOPBACK, address_of, tls_of

    known = find(options.what)
    fleet = resolved(as_running(known))
    host = LOOPBACK if options.listen is None else address_of(options.listen)
    tls = None if options.listen is None else tls_of(fleet, host, options.port)
    is_ours = any(not run.attached for run in known.runs)  # `handfast run` drives it, and nobody else
    with operator_bus(fleet) as bus:
        connected(Session(fleet, bus))
        try:
            server = LiveServer(
                *(fleet, bus, None if options.read_only else lambda: ways(fleet), options.port),
                source=None if is_ours else str(known.fleet_file),
                host=host,
                tls=tls,
            )
        except OSError as error:
            raise _taken(options, error) from error
        with ExitStack() as stack:
            stack.callback(server.close)
            if options.foxglove is not None:
                _serve_foxglove(options, server, stack)
            serving = _beside(Path(options.what), server) if options.beside else server.serve()
            return _serve(options, server.address, serving)


def _serve_foxglove(options: argparse.Namespace, server: LiveServer, stack: ExitStack) -> None:
    """Has Foxglove see what the page sees.

    Raises:
        InputError: the port is taken.
    """
    from handfast.deploy.view.foxglove import FoxgloveServer, ServeError, layout_path

    try:
        foxglove = FoxgloveServer(server.live.fleet, options.foxglove)
    except ServeError as error:
        raise InputError(f"--foxglove: {error}") from None
    stack.callback(foxglove.close)
    server.live.want_forces()  # its hand states are shown, too
    server.live.listeners.append(foxglove.feed)
    print(f'{foxglove.address}  ("Foxglove WebSocket"; layout to import: {layout_path()})', flush=True)


def _started(options: argparse.Namespace) -> int:
    """The page of a run that another command begins now: waits until its fleet is there, or that command is
    not."""
    from handfast.agent.transport.bus import BusError
    from handfast.deploy.inventory.known_fleets import NotRunningError

    while not select.select([sys.stdin], [], [], RETRY_S)[0]:
        with suppress(NoAnswerError, NotRunningError, BusError, FleetError):
            return _live(options)
    return INTERRUPTED


async def _beside(folder: Path, server: LiveServer) -> None:
    """Serves the page of a run: the fleet, and, as its command says that it is over, the recording."""
    import asyncio

    from handfast.deploy.view.beside import OVER, RECORDED

    loop = asyncio.get_running_loop()
    serving = asyncio.create_task(server.serve())
    reader = asyncio.StreamReader()
    await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(reader), sys.stdin)
    try:
        while said := await reader.readline():
            if said == OVER:
                server.end()
            elif said == RECORDED:
                server.show(await asyncio.to_thread(_answers, folder))
    finally:
        serving.cancel()
        with suppress(asyncio.CancelledError):
            await serving


def _answers(folder: Path) -> Answer:
    from handfast.deploy.recording.mcap_reader import read_run
    from handfast.deploy.verdict.run_result import RunResult
    from handfast.deploy.view.recorded import answers

    return answers(RunResult(read_run(folder)))


def _taken(options: argparse.Namespace, error: OSError) -> InputError:
    if options.listen is not None and error.errno != errno.EADDRINUSE:
        return InputError(f"--listen {options.listen}: {error.strerror or error}")
    return InputError(f"--port {options.port}: {error.strerror or error}; leave it out for any")


def _serve(options: argparse.Namespace, address: str, serving: Coroutine[Any, Any, None]) -> int:
    """Serves until Ctrl-C."""
    import asyncio

    from handfast.deploy.view.server import open_browser

    try:
        print(f"{address}  (Ctrl-C ends it)", flush=True)
    except OSError:  # nobody reads it
        serving.close()
        raise
    if options.browser:
        open_browser(address)
    with suppress(KeyboardInterrupt), as_python_does():
        asyncio.run(serving)
    return INTERRUPTED
