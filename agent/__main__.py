"""``python -m agent --fleet FILE --robot ID``: the agent of one robot as a process."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from agent.core import Agent
from agent.fleet import Fleet
from agent.formation import resolved
from agent.process import main


def start(fleet: Fleet, robot: int) -> tuple[Agent, Sequence[str], Sequence[str]]:
    """The agent and its endpoints: of two neighbours, the one with the greater id connects."""
    fleet = resolved(fleet)
    agent = Agent(fleet, robot)
    connect = [fleet.agent_endpoint(other) for other in fleet.neighbours(robot) if other < robot]
    return agent, [fleet.agent_endpoint(robot)], connect


if __name__ == "__main__":
    sys.exit(main(None, "python -m agent", "agent", start))
