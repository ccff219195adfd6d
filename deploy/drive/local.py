"""A fleet on this machine: one process for each agent and each plant, driven to the end
(`deploy.drive.drive`)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from pathlib import Path
from typing import Final

from handfast.agent.fleet.model import Fleet
from handfast.agent.transport.bus import Bus
from handfast.deploy.console.interrupt import Interrupt
from handfast.deploy.drive.display.live_view import View
from handfast.deploy.drive.drive import Drive
from handfast.deploy.drive.preconditions import Timing
from handfast.deploy.inventory.registry import Registration
from handfast.deploy.processes.attributes import interrupting_nobody
from handfast.deploy.processes.child import environment
from handfast.deploy.processes.forking import ForkServer
from handfast.deploy.processes.local import Processes
from handfast.deploy.processes.placement import Vehicle, held_orders, orders_folder
from handfast.deploy.report.run_folder import RunFolder
from handfast.deploy.session.operator_bus import operator_bus
from handfast.deploy.session.stop_by_file import FileWay

LISTEN_MORE: Final = 2
"""Periods more until the first tick in which a robot may drive."""
END_TIMEOUT_S: Final = 2.0
END_EACH_S: Final = 0.02
"""Processes have so long to end, and so much longer for each of them: on a busy machine they wait for each
other. They take a few tenths of a second where it has time for them."""


class LocalRun:
    """One run: starts the processes of `fleet` (resolved and placed, with these simulated rovers), drives it
    and ends it. `source`: the fleet file that it is started from, for whoever looks for it by that.

    After `run`, `reasons` holds what went wrong in the operator's eyes, as sentences for the verdict.
    """

    def __init__(
        self,
        fleet: Fleet,
        folder: RunFolder,
        view: View,
        interrupt: Interrupt,
        vehicles: Sequence[Vehicle] = (),
        source: Path | None = None,
    ) -> None:
        self._source, self._server = source, ForkServer(environment())
        self._fleet, self._folder, self._view, self._vehicles = fleet, folder, view, vehicles
        self._interrupt = interrupt
        self._orders = orders_folder(fleet)
        self._processes = Processes(
            *(fleet, folder.fleet_file, folder.log, vehicles), orders=self._orders, server=self._server
        )
        self.reasons: list[str] = []
        self.warnings: list[str] = []

    def run(self) -> None:
        """From start to end; whatever happens, no process is left.

        Raises:
            handfast.agent.transport.bus.BusError: the operator's session cannot be opened.
            handfast.deploy.recording.run_files.RecordingError: the recording cannot be written (the fleet is
            stopped first).
        """
        # Known before it starts and until it has ended: whoever wants to stop it must find it.
        name, path = self._fleet.fleet.name, self._folder.path
        with (
            interrupting_nobody() if self._fleet.is_routed else nullcontext(),
            self._server,
            Registration(name, path, self._folder.fleet_file, self._source),
            held_orders(self._fleet),
        ):
            try:
                with self._started() as bus:
                    drive = Drive(
                        *(self._fleet, self._processes, bus, self._folder.record),
                        *(self._view, self._interrupt),
                        timing=Timing.of_own_machine(len(self._processes.names), self._listening_ns),
                        ways=lambda: [FileWay(self._fleet, self._orders)],
                    )
                    self.reasons, self.warnings = drive.reasons, drive.warnings
                    drive.run()
                    if drive.is_behind:  # the processor is left to this command then
                        self._end()
                        drive.take_rest()
            finally:
                self._end()

    def _end(self) -> None:
        """Ends all processes that have not ended yet."""
        timeout_s = END_TIMEOUT_S + END_EACH_S * self._processes.count
        for child in self._processes.end(timeout_s):
            self._view.say(f"{child.name} did not end when asked and was killed")

    @property
    def _listening_ns(self) -> int:
        fleet = self._fleet
        return (fleet.listening_rounds + LISTEN_MORE) * fleet.period_ns

    @contextmanager
    def _started(self) -> Iterator[Bus]:
        """Starts all processes; a bus on which they are."""
        self._say_start()
        self._processes.start_routers()
        with ExitStack() as stack:
            bus = None
            if self._fleet.routers:  # before so many others want it
                bus = stack.enter_context(operator_bus(self._fleet))
            self._processes.start()
            for vehicle in self._vehicles:
                self._view.say(str(vehicle))
            yield bus or stack.enter_context(operator_bus(self._fleet))

    def _say_start(self) -> None:
        count = len(self._fleet.robots)
        self._view.say(
            f"starting {count} agents and {count} plants{self._processes.says_sharing} on ports "
            f"{self._fleet.network.base_port} to {self._fleet.network.base_port + 2 * count - 1}"
            f"{self._through()}"
        )

    def _through(self) -> str:
        routers = self._fleet.routers
        if not routers:
            return ""
        count = f"{len(routers)} routers" if len(routers) > 1 else "a router"
        return f", through {count} on {routers[0].where}"
