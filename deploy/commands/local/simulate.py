"""The command ``handfast simulate``: drives a fleet in virtual time, and reports."""

from __future__ import annotations

import argparse
import sys
import time
from typing import Final

from handfast.agent.common.errors import FAILED
from handfast.agent.common.time import NS_PER_S
from handfast.deploy.console.arguments import drive_arguments, fleet_arguments, load
from handfast.deploy.console.interrupt import NOT_STARTED, Interrupt
from handfast.deploy.drive.outcome import finish, refuse_errors, run_folder

WAITING_MAX: Final = 2000
"""So many messages wait at most before they are recorded."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what ``handfast simulate`` takes."""
    fleet_arguments(parser)
    drive_arguments(parser)
    parser.set_defaults(command=_simulate)


def _simulate(options: argparse.Namespace) -> int:
    from handfast.agent.formation.geometry import resolve
    from handfast.deploy.drive.display.live_view import make_view
    from handfast.deploy.drive.watch import Watch
    from handfast.deploy.recording.run_files import RecordingError
    from handfast.deploy.simulate.simulation import Simulation

    interrupt = Interrupt()
    with interrupt.caught():
        with interrupt.answered(NOT_STARTED, raises=True):
            fleet = load(options)
            refuse_errors(options, fleet)
        folder = run_folder(options, fleet, "simulate")
        watch = Watch(fleet, resolve(fleet))
        view = make_view(quiet=options.quiet, period_s=fleet.fleet.duration_s / 10)

        # One after the other they are taken in two thirds of the time that each takes between two ticks, for
        # robots and recorder would drive each other out of the processor's caches.
        waiting: list[tuple[int, str, bytes]] = []

        def take() -> None:
            came = waiting.copy()
            waiting.clear()
            for received_ns, key, payload in came:
                message = folder.record(received_ns, key, payload, simulation.decode)
                if message is not None:
                    watch.feed(key, message)

        def sink(received_ns: int, key: str, payload: bytes) -> None:
            waiting.append((received_ns, key, payload))
            if len(waiting) >= WAITING_MAX:
                take()

        shown = 0

        def progress(time_s: float) -> bool:
            nonlocal shown
            take()
            for sentence in [*watch.news(time_s), *simulation.reasons[shown:]]:
                view.say(sentence)
            shown = len(simulation.reasons)
            view.show(watch.picture(time_s))
            return interrupt.count == 0

        begun = time.perf_counter()
        try:
            with view:
                simulation = Simulation(fleet, sink)
                try:
                    simulation.run(progress)
                finally:
                    take()
        except RecordingError as error:
            print(f"handfast: {error}", file=sys.stderr)
            return FAILED
        took = time.perf_counter() - begun
        if not options.quiet:
            driven = max(0.0, (simulation.now_ns - simulation.epoch_ns) / NS_PER_S)
            speed = driven / took
            times = f"{speed:.0f}" if speed > 9.5 else f"{speed:.2g}"  # of a large fleet it is less than 1
            view.say(f"{driven:.1f} s of driving in {took:.2f} s, {times} times real time")
        return finish(options, folder, simulation.reasons, interrupt)
