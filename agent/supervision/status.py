"""The status that an agent publishes: its state, ages of neighbours, counters, tick times (PURE)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from typing import Final

from handfast.agent.common.named_tuples import new
from handfast.agent.common.time import NS_PER_S
from handfast.agent.control.peers.peer import NEVER, Peer
from handfast.agent.messages.types import NeighbourStatus, Status, Total
from handfast.agent.supervision.overload import Overload

STATUS_HZ: Final = 5.0
"""How often an agent says its status to operators, at the full rate of a drive..."""
STATUSES_HZ: Final = 300.0
"""...where all together say no more than so many a second. One that is waited for comes at once: of another
state, or of an order that is acknowledged."""
OPENED_ANEW_NS: Final = 5 * NS_PER_S
"""For so long a status says that a link was opened anew."""
STATUS_VALUES_MAX: Final = 200
"""A status goes out early rather than hold more tick times or ages than this."""


def status_hz(robots: int) -> float:
    """How often an agent of a fleet of so many robots says its status while nothing changes, 1/s."""
    return min(STATUS_HZ, STATUSES_HZ / robots)


class StatusReport:
    """Collects what happens between two status messages, counts what happened since the start.

    Args:
        rejected: messages that were not valid, by reason.
        overload: of its own process.
        hz: how often a status is due, 1/s.

    Attributes:
        ages_us: ages of neighbours' states that the law worked with since the last status, us.
        sent_hands: hand states sent, one for each neighbour.
        corrupted: hand states whose bytes were damaged.
        digest: of its fleet file, once it has refused a mission for another one: `Status.digest`.
    """

    def __init__(
        self,
        rejected: Counter[str],
        overload: Overload,
        hz: float = STATUS_HZ,
    ) -> None:
        self._period_ns: Final = round(NS_PER_S / hz)
        self._rejected, self._overload = rejected, overload
        self._interventions: Counter[str] = Counter()
        self.ages_us: Final[list[int]] = []
        self.sent_hands = self.corrupted = 0
        self.digest: tuple[str, ...] = ()
        self._tick_us: list[int] = []
        self._overruns = 0
        self._sequence = self._due_ns = 0
        self._opened_anew: dict[str, int] = {}
        self._links_opened_anew = 0

    def timed(self, duration_ns: int, missed: int) -> None:
        """Takes how long a tick took, and how many were skipped before it."""
        self._tick_us.append(duration_ns // 1000)
        self._overruns += missed

    def intervened(self, causes: Collection[str]) -> None:
        """Counts a tick in which the safety filter changed what the law asked for, if it did, by cause."""
        if causes:
            self._interventions.update(causes)
        self._interventions["any"] += bool(causes)

    def link_opened_anew(self, now_ns: int, what: str) -> None:
        """Counts that a link was opened anew; `what` says which, and why."""
        self._links_opened_anew += 1
        self._opened_anew[what] = now_ns

    def opened_anew(self, now_ns: int) -> str:
        """Which links were of late, "" for none."""
        self._opened_anew = {
            what: then_ns for what, then_ns in self._opened_anew.items() if now_ns - then_ns < OPENED_ANEW_NS
        }
        return "; ".join(self._opened_anew)

    def hurry(self) -> None:
        """There is news that operators wait for: the next status goes out with the next tick."""
        self._due_ns = 0

    def is_due(self, now_ns: int) -> bool:
        """Whether it is time for the next status, or more has come than one can hold."""
        return now_ns >= self._due_ns or len(self.ages_us) > STATUS_VALUES_MAX

    def status(
        self,
        now_ns: int,
        robot: int,
        situation: tuple[str, str, str],
        mission_version: int,
        stop_version: int,
        neighbours: Sequence[Peer],
        known: Iterable[Peer],
    ) -> Status:
        """The next message, after which collecting begins anew.

        Args:
            situation: state, the transition that led there, and its reason.
            mission_version, stop_version: of the mission and the stop or resume that were taken last.
            neighbours: peers at the other ends of the robot's edges, in their order.
            known: all other robots, heard or not.
        """
        received = lost = delayed = duplicated = 0
        for peer in known:  # once: in a large fleet these are many
            if peer.hand_ns != NEVER:
                received, lost = received + peer.received, lost + peer.lost
                delayed, duplicated = delayed + peer.delayed, duplicated + peer.duplicated
        counters = {
            "sent": self.sent_hands,
            "received": received,
            "lost": lost,
            "delayed": delayed,
            "duplicated": duplicated,
            "corrupted": self.corrupted,
            "rejected": sum(self._rejected.values()),
            "overruns": self._overruns,
            **({"links.opened_anew": self._links_opened_anew} if self._links_opened_anew else {}),
            **self._overload.counters(),
            **{f"rejected.{reason}": count for reason, count in sorted(self._rejected.items())},
            **{f"filtered.{cause}": count for cause, count in sorted(self._interventions.items())},
        }
        status = Status(
            robot,
            self._sequence,
            now_ns,
            *situation,
            mission_version,
            stop_version,
            tuple(
                NeighbourStatus(
                    peer.robot,
                    -1 if (age := peer.age_ns(now_ns)) is None else max(age, 0) // 1000,
                    peer.received,
                    peer.lost,
                    peer.clock.offset_us,
                    peer.clock.error_us,
                )
                for peer in neighbours
            ),
            tuple(self._tick_us[:STATUS_VALUES_MAX]),
            tuple(self.ages_us[: STATUS_VALUES_MAX + len(neighbours)]),
            tuple([new(Total, each) for each in counters.items()]),
            self.digest,
        )
        self._sequence += 1
        self._due_ns = now_ns + self._period_ns
        self._tick_us.clear()
        self.ages_us.clear()
        return status
