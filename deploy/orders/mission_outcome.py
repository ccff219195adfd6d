"""What became of a new mission: which robots have acknowledged it (PURE)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from handfast.agent.common.time import NS_PER_S
from handfast.agent.messages.codec import newer
from handfast.agent.messages.types import Mission, Status
from handfast.deploy.console.wording import grouped, robots


def words(mission: Mission) -> str:
    """What a mission changes, and when, in fleet time."""
    at_s = ((mission.from_ns or mission.epoch_ns) - mission.epoch_ns) / NS_PER_S
    over = f", over {mission.blend_ns / NS_PER_S:.1f} s" if mission.blend_ns else ""
    return f"{mission.note}: at {at_s:.1f} s{over}"


class Ordering:
    """What becomes of a new mission, from the statuses that come after it.

    Args:
        mission: as it is sent.
        ids: all robots of the fleet.
    """

    def __init__(self, mission: Mission, ids: Sequence[int]) -> None:
        self._mission, self._ids = mission, ids
        self._removed = {robot for robot, _ in mission.removed}
        self._agents: Sequence[int] = ()
        self._statuses: Mapping[int, Status] = {}
        self._newest: Mission | None = None

    def look(self, agents: Sequence[int], statuses: Mapping[int, Status], newest: Mission | None) -> bool:
        """Takes what was heard until now: the robots whose agents are there, their last statuses, and the
        newest mission. True when nothing is left to wait for."""
        self._agents, self._statuses, self._newest = agents, statuses, newest
        return self.overruled or (bool(agents) and all(map(self.has_acknowledged, agents)))

    def has_acknowledged(self, robot: int) -> bool:
        """Whether a robot's agent has acknowledged the mission."""
        status = self._statuses.get(robot)
        return status is not None and status.mission_version == self._mission.version

    @property
    def overruled(self) -> bool:
        """Whether a newer mission of another operator holds instead."""
        later = any(status.mission_version > self._mission.version for status in self._statuses.values())
        return later or (self._newest is not None and newer(self._newest, self._mission))

    @property
    def done(self) -> bool:
        """Whether every robot of the fleet has acknowledged it, but for those that have been removed."""
        return not self.overruled and all(
            self.has_acknowledged(robot) if robot in self._agents else robot in self._removed
            for robot in self._ids
        )

    def outcomes(self) -> list[str]:
        """What became of it, in words: how many have acknowledged it, and what is with the others."""
        if self.overruled:
            other = self._newest
            known = other is not None and newer(other, self._mission)
            what = f" ({other.note})" if other is not None and known and other.note else ""
            if known and other is not None and other.version == self._mission.version:
                return [f"not done: another operator's order was quicker{what}; look, and order again"]
            # That may have been made of this one: who orders again would have it twice.
            text = f"overtaken by another operator's order{what}, maybe on top of it"
            return [f"{text}; look before ordering again"]
        have = sum(map(self.has_acknowledged, self._ids))
        due = sum(robot in self._agents or robot not in self._removed for robot in self._ids)
        lacking = [(self._outcome(robot), robot) for robot in self._ids if not self.has_acknowledged(robot)]
        return [
            f"{have} of {due} acknowledged",
            *(f"{robots(ids)}: {text}" for text, ids in grouped(lacking)),
        ]

    def _outcome(self, robot: int) -> str:
        if robot not in self._agents and robot in self._removed:
            return "has been removed"
        if robot not in self._agents:
            return "its agent is not there; the others will relay it"
        status = self._statuses.get(robot)
        if status is None:
            return "nothing heard from its agent"
        return f"has not taken it: {status.reason or status.state}"
