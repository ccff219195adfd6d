"""A fleet whose processes others have started: seen by their liveliness tokens, and left as they are."""

from __future__ import annotations

import time
from collections.abc import Collection, Sequence
from typing import Final

from handfast.agent.control.hand import Pose
from handfast.agent.fleet.model import Fleet
from handfast.agent.messages.key_expressions import ROLES
from handfast.deploy.console.interrupt import Interrupt
from handfast.deploy.console.wording import robots
from handfast.deploy.drive.preconditions import refusal
from handfast.deploy.faults.process_actions import Action, Process
from handfast.deploy.session.operator_session import OperatorSession
from handfast.deploy.session.session import connected

NAMED_MAX: Final = 6
"""Of processes that go at one time, as when this machine is cut off, so many are named."""


class Attached:
    """The agents and plants of `fleet`, wherever they run.

    A connection that is lost is only reported: whether its process has ended, is frozen or is cut off is not
    known here; what runs it starts it again, and the others drive on.
    """

    def __init__(self, fleet: Fleet) -> None:
        self.ours: Final = False
        self.begun_s: Final = time.monotonic()
        self.names: Final = {
            (robot, role): f"robot {robot}'s {role}" for robot in fleet.ids for role in ROLES
        }
        self.count: Final = len(self.names)
        self._away: list[str] = []
        self._ids = fleet.ids
        self._records = fleet.recording.max_mb > 0 and any(robot.host is not None for robot in fleet.robots)
        self._unseen: set[int] = set()
        """Robots of which nothing could be heard in the drive, but that may have recorded it."""
        self._present: frozenset[Process] = frozenset()
        self._gone_s: dict[Process, float | None] = {}
        """Those that were there and are not, and since when (fleet time)."""

    def up(self, robot: int, role: str) -> bool:
        return (robot, role) in self._present

    def look(self, present: Collection[Process], time_s: float | None) -> list[str]:
        gone, back = [], []
        for process, name in self.names.items():
            if process in self._present and process not in present:
                self._gone_s[process] = time_s
                gone.append(name)
            elif process in present and process in self._gone_s:
                since_s = self._gone_s.pop(process)
                back.append(name)
                if since_s is not None and time_s is not None and time_s > 0.0:
                    self._away.append(f"No connection to {name} from {since_s:.1f} s to {time_s:.1f} s")
        self._present = frozenset(present)
        if gone and self._records and time_s is not None and time_s > 0.0:
            self._unseen |= {
                robot for robot in self._ids if all((robot, role) in self._gone_s for role in ROLES)
            }
        at = "" if time_s is None else f"{time_s:.1f} s: "
        sentences = [f"{at}no connection to {_named(gone)}"] if gone else []
        return [*sentences, f"{at}connected again: {_named(back)}"] if back else sentences

    @property
    def warnings(self) -> list[str]:
        """Sentences for the verdict, of those that were away for a while."""
        if not self._unseen:
            return self._away
        who = robots(sorted(self._unseen))
        return [
            *self._away,
            f"Nothing could be heard of {who} for a while: if only this machine was cut off, they drove on, "
            "and `handfast fetch` has what they recorded",
        ]

    def deaths(self) -> tuple[()]:
        """None: how a process on another machine has ended is not known here."""
        return ()

    def lacking(self, members: Collection[int]) -> list[str]:
        out = []
        for process, since_s in self._gone_s.items():
            text = f"No connection to {self.names[process]}"
            text += "" if since_s is None else f" since {since_s:.1f} s"
            if process[0] in members:
                out.append(f"{text}.")
            else:
                self._away.append(f"{text}; it has no place in the formation any more")
        return out

    def carry_out(self, action: Action, pose: Pose | None) -> bool:
        """Nothing is done to processes that are others'."""
        return False

    def resume_all(self) -> None:
        """None was paused."""


def _named(names: Sequence[str]) -> str:
    more = len(names) - NAMED_MAX
    return ", ".join(names[:NAMED_MAX]) + (f" and {more} more" if more > 0 else "")


def refused(fleet: Fleet, interrupt: Interrupt, *, resume: bool, given_ns: int) -> str:
    """Why no drive of a fleet that is up may begin (`deploy.drive.preconditions.refusal`), "" when it may.

    Raises:
        handfast.deploy.inventory.known_fleets.NoAnswerError: nobody is there.
        handfast.agent.transport.bus.BusError: the bus cannot be opened.
    """
    with connected(OperatorSession(fleet), interrupt) as session:
        session.ask()
        return refusal(session.operator, session.now_ns(), resume=resume, given_ns=given_ns)
