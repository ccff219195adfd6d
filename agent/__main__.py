"""``python -m handfast.agent --fleet FILE --robot ID``: the agent of one robot as a process."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from functools import partial

from handfast.agent.common.time import Clock
from handfast.agent.core import Agent
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolved
from handfast.agent.links.ticks import Ticks, agent_slot_ns
from handfast.agent.runtime.loop import Log
from handfast.agent.runtime.process import Start
from handfast.agent.runtime.process import main as process_main


def start(fleet: Fleet, robot: int, _clock: Clock, _log: Log) -> Start:
    """The agent and its endpoints: of any two, the one that is later in the file connects."""
    if not fleet.is_resolved:
        fleet = resolved(fleet)
    agent = Agent(fleet, robot)
    # To all, not only to its neighbours: everybody hears everybody's beacons, and peers do not relay.
    others = fleet.ids[: fleet.index(robot)] if not fleet.routers else ()
    connect = [fleet.agent_endpoint(other) for other in others]
    ticks_from = partial(Ticks, agent, slot_ns=agent_slot_ns(fleet, robot))
    return Start(agent, fleet.agent_listens(robot), connect, ticks_from=ticks_from)


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the process; returns its exit status.

    Args:
        argv: the command line after the program's name; None: that of this process.
    """
    return process_main(argv, "python -m handfast.agent", "agent", start)


if __name__ == "__main__":
    sys.exit(main())
