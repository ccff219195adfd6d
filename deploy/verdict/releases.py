"""Robots whose bodies did not do what was asked: their operators' doing, or not.

A body that does not obey is its operator's, by the contract of plants (`PlantState.obeying`), and its agent
is in state released. A bridge lets go of a vehicle by itself, too: of one that does not follow, that has
rebooted, or that its operator may have had, for nothing was heard of it or the bridge started in mid-drive;
and a failsafe of the vehicle takes it from both. Nothing that is recorded tells these apart but the reason
that the agent gives, in the bridge's words: `NOT_ITS_OPERATORS`, `PERHAPS_ITS_OPERATORS`.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Final, NamedTuple

from handfast.agent.supervision.state_machine import State
from handfast.deploy.recording.recording import Recording

NOT_ITS_OPERATORS: Final = (
    "does not follow its commands",
    "stands before its own fence",
    "its own failsafe has it",
)
"""How a bridge begins the reason for which it has let go of a vehicle that nobody had taken."""
PERHAPS_ITS_OPERATORS: Final = (
    "its bridge has started in mid-drive",
    "nothing was heard of it",
    "it has rebooted",
)
"""And of one that its operator may have had: not his, as long as he is not seen to have taken it."""


class Release(NamedTuple):
    """A time in which a robot was released, in the drive.

    Attributes:
        end_s: None where it lasted to the end of the drive.
        reason: what it said; of all that it said, why it was let go first.
        by_operator: whether its operator had taken it.
    """

    robot: int
    start_s: float
    end_s: float | None
    reason: str
    by_operator: bool

    @property
    def is_loss(self) -> bool:
        """Whether the robot was lost to the drive, and nobody had wanted that."""
        return self.end_s is None and not self.by_operator


def releases(recording: Recording) -> list[Release]:
    """All of them, robot by robot, in order."""
    out = []
    for robot, data in recording.robots.items():
        status = data.status
        for start_s, end_s, first in status.periods(State.RELEASED.value):
            if start_s >= recording.end_s:
                continue
            said = [
                reason
                for t, reason in zip(status.t.tolist(), status.reasons, strict=True)
                if start_s <= t and (end_s is None or t < end_s)
            ]
            # Its operator may have come for it later.
            own = next((reason for reason in said if reason.startswith(NOT_ITS_OPERATORS)), None)
            if own is None and said[-1].startswith(PERHAPS_ITS_OPERATORS):
                own = said[-1]
            until_s = None if end_s is None or end_s >= recording.end_s else end_s
            out.append(Release(robot, start_s, until_s, own or first, own is None))
    return out


def losses(recording: Recording, among: Collection[int]) -> list[str]:
    """Sentences for those of some robots that followed no more, though no operator had taken them."""
    return [
        f"Robot {each.robot} followed no more from {each.start_s:.1f} s to the end, and its operator had not "
        f"taken it: {each.reason}."
        for each in releases(recording)
        if each.is_loss and each.robot in among
    ]


def warnings(recording: Recording, members: Collection[int]) -> list[str]:
    """Sentences for all other times: `members` are robots of which `losses` tells."""
    out = []
    for each in releases(recording):
        if each.is_loss and each.robot in members:
            continue
        until = "the end" if each.end_s is None else f"{each.end_s:.1f} s"
        why = f" ({each.reason})" if each.reason else ""
        whose = " to its operator" if each.by_operator else ""
        out.append(
            f"Robot {each.robot} was released{whose} from {each.start_s:.1f} s to {until}{why}: it did not "
            "follow the law then."
        )
    return out
