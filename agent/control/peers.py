"""The other robots as one robot hears them: the latest message of each, its age, and how far to trust it.

Pure. Others are heard in two ways: by the hand states of those that are listened to (one a tick: neighbours
in the formation graph, and whoever is near), and by the beacons of all (a few a second).

A robot stamps its messages and follows the mission by its own clock. So all that is about it is computed
in that clock: the own one plus its offset, as far as that is proven (`agent.control.clock_offset`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Final

from agent.common.time import NS_PER_S
from agent.control.clock_offset import ClockOffset
from agent.control.prediction import Prediction, as_it_came, coasting, following
from agent.formation.trajectory import Sample
from agent.messages.types import FUTURE_NS_MAX, NEIGHBOURS_MAX, SILENT_MAX, Beacon, HandState, Silent

DOUBT_RATE: Final = 0.15
"""How fast the position uncertainty of a robot grows that is not heard, m/s: about what another acceleration
than the predicted one makes of a robot's place in a second."""
DOUBT_AFTER_S: Final = 0.1
"""It grows from this age of a robot's last message on."""
DOUBT_MAX: Final = 0.3
"""Largest position uncertainty, m: of what a robot says itself, and of what its silence adds."""
UNSURE_NS: Final = NS_PER_S // 4
"""A robot that has not been heard for so long may have stopped, and is not trusted to keep a distance."""
SILENT_NS: Final = NS_PER_S
"""Beacons name a robot that has been silent for so long,"""
HEARSAY_NS: Final = 60 * NS_PER_S
"""and no longer than this."""
WAY_STEPS: Final = 4
"""The way of a robot since its last message is taken as so many straight pieces."""
TRUST_LOST_S: Final = 0.5
"""Trust falls from 1 to 0 within this time: an edge to a robot that is given up loses its force."""
TRUST_GAINED_S: Final = 1.5
"""Trust rises from 0 to 1 within this time: the edge is back without a bump."""
_NEVER: Final = -1

Motion = Callable[[int, int], Sample | None]
"""(robot, wall time ns) -> its desired motion, None for one without a place:
`agent.formation.reference.Reference.motion`."""


class Peer:
    """One other robot. `Peers` writes it, others read.

    Attributes:
        message: its latest, a hand state, or a beacon in the form of one; None when nothing has come.
        hand_ns: stamp of its latest hand state, -1 while none has come.
        clock: what is known of its clock.
        token: False while its agent's process is seen to be gone.
        here: likewise, but True again only when it has been heard again.
        trust: 0..1, how far an edge to it is trusted.
        copy: its copy of the shared multiplier that has come since the last `Peers.take_copy`, if any.
        degree: constraints that act on it.
        ahead_ns: how far its last message was stamped ahead of the own clock if it was refused as
            ``future``, else 0.
        other_version: what its messages and this program speak, once one was refused for that; else "".
        received, lost, delayed, duplicated: hand states since the start.
    """

    __slots__ = (
        "ahead_ns", "clock", "copy", "degree", "delayed", "duplicated", "early", "hand_ns", "here", "lost",
        "message", "other_version", "received", "robot", "sequence", "time_ns", "token", "trust",
    )  # fmt: skip

    def __init__(self, robot: int, period_ns: int) -> None:
        self.robot = robot
        self.message: HandState | None = None
        self.early: HandState | None = None
        self.time_ns = self.hand_ns = self.sequence = _NEVER
        self.clock = ClockOffset(period_ns)
        self.here = self.token = True
        self.trust = 0.0
        self.copy: float | None = None
        self.degree = 0
        self.ahead_ns = 0
        self.other_version = ""
        self.received = self.lost = self.delayed = self.duplicated = 0

    def age_ns(self, now_ns: int) -> int | None:
        """Age of its hand state by its own clock, None when none has come.

        Below 0 where its clock is further ahead than is proven.
        """
        return None if self.hand_ns == _NEVER else now_ns + self.clock.used_ns - self.hand_ns

    def doubt(self, now_ns: int) -> float:
        """Its position uncertainty, m: as it says itself, and by the age of that."""
        said = 0.0 if self.message is None else min(DOUBT_MAX, self.message.doubt)
        age_s = (now_ns + self.clock.used_ns - self.time_ns) / NS_PER_S - DOUBT_AFTER_S
        return said + min(DOUBT_MAX, DOUBT_RATE * age_s) if age_s > 0.0 else said


class Peers:
    """The other robots, as robot `owner` hears them.

    Args:
        owner: id of the robot that listens.
        c1, c2: navigation gains (21) of all.
        period_ns: time between two hand states of one robot.
        motion: desired motion of every robot.
        decay: of a robot's constraint force, 1/s (`agent.control.prediction.constraint_decay`).
        predict: False takes every message as it came, whatever its age.
        most: speed limit of all (m/s) by which they make for their places (N1), None without one.

    Attributes:
        epoch_ns: a message from before is of a robot that stands until then.
    """

    def __init__(
        self,
        owner: int,
        c1: float,
        c2: float,
        period_ns: int,
        motion: Motion,
        *,
        decay: float = 0.0,
        predict: bool = True,
        most: float | None = None,
    ) -> None:
        self._owner = owner
        self._c1, self._c2 = c1, c2
        self._period_ns = period_ns
        self._motion = motion
        self._decay, self._predict, self._most = decay, predict, most
        self.epoch_ns = 0
        self._known: dict[int, Peer] = {}
        self._early: list[Peer] = []
        self._early_beacons: list[tuple[Peer, Beacon]] = []
        self._tick_ns = _NEVER
        self._heard: tuple[tuple[int, int], ...] | None = ()

    def get(self, robot: int) -> Peer:
        """What is known of a robot, though it be nothing."""
        peer = self._known.get(robot)
        if peer is None:
            peer = self._known[robot] = Peer(robot, self._period_ns)
        return peer

    @property
    def known(self) -> Iterable[Peer]:
        """All robots that something is known of."""
        return self._known.values()

    def forget(self, robot: int) -> None:
        """Forgets a robot that is not there any more."""
        if self._known.pop(robot, None) is not None:
            self._heard = None

    # ------------------------------------------------------------------ what comes

    def begin(self, now_ns: int) -> None:
        """Begins the tick at `now_ns`, if it has not begun: takes what came too early for the last one."""
        if now_ns > self._tick_ns:
            self._tick_ns = now_ns
            if self._early_beacons:
                beacons, self._early_beacons = self._early_beacons, []
                for peer, beacon in beacons:
                    if beacon.time_ns > peer.time_ns and self._known.get(peer.robot) is peer:
                        self._take_beacon(peer, beacon)
            if self._early:
                early, self._early = self._early, []
                for peer in early:
                    message, peer.early = peer.early, None
                    if message is not None and message.time_ns > peer.hand_ns:
                        self._take(peer, message, now_ns)

    def accept(self, message: HandState, now_ns: int) -> str | None:
        """Takes a hand state at the tick `now_ns`; returns why it is refused, None when it is taken.

        Refused, with nothing changed: ``future``, ``duplicate`` and ``out_of_order`` (not newer than what is
        known). A sender that starts again counts its messages from 0 but its clock goes on: the time decides
        what is newer.

        All robots tick at once, and which of them sees which other's message of the same tick
        would be up to the scheduler. So a message of this tick waits for the next one: every
        robot works with the others' last tick, as the joint sweep assumes.
        """
        self.begin(now_ns)
        peer = self.get(message.robot)
        time_ns = message.time_ns
        clock = peer.clock
        used_ns = clock.used_ns
        if self._from_future(peer, time_ns, now_ns):
            return "future"
        if time_ns <= peer.hand_ns:
            return _refuse(peer, time_ns == peer.hand_ns)
        early = now_ns <= time_ns - used_ns < now_ns + self._period_ns
        if early:
            if peer.early is not None and peer.early.time_ns >= time_ns:
                return _refuse(peer, peer.early.time_ns == time_ns)
            if peer.early is None:
                self._early.append(peer)
            peer.early = message
        echo_us = None
        for robot, delay_us in message.heard:
            if robot == self._owner:
                echo_us = delay_us
                break
        if clock.take(now_ns, time_ns, echo_us):
            self._heard = None
        peer.ahead_ns = 0
        if not early:
            self._take(peer, message, now_ns)
        return None

    def accept_beacon(self, beacon: Beacon, now_ns: int) -> str | None:
        """Takes a beacon and what it says of the silent; returns why it is refused, as `accept`.

        One of this tick waits for the next one as well: to a robot whose clock is behind, all are.
        """
        if beacon.silent:
            self.accept_silent(beacon, now_ns)
        self.begin(now_ns)
        peer = self.get(beacon.robot)
        if self._from_future(peer, beacon.time_ns, now_ns):
            return "future"
        if beacon.time_ns <= peer.time_ns:
            return None  # a hand state was quicker
        if beacon.time_ns - peer.clock.used_ns < now_ns:
            self._take_beacon(peer, beacon)
        else:
            self._early_beacons.append((peer, beacon))
        return None

    def accept_silent(self, beacon: Beacon, now_ns: int) -> None:
        """Takes a beacon's rows about robots that its sender does not hear, where they are news here."""
        for said in beacon.silent:
            if said.robot == self._owner or not now_ns - HEARSAY_NS < said.time_ns <= now_ns:
                continue
            peer = self.get(said.robot)
            if said.time_ns > peer.time_ns:
                place = said.x, said.y, said.vx, said.vy
                peer.message = HandState.placed(
                    said.robot, 0, said.time_ns, said.following, peer.degree, place
                )
                peer.time_ns = said.time_ns

    def silent(self, now_ns: int, x: float, y: float) -> tuple[Silent, ...]:
        """Robots that have not been heard for a while: those nearest to (x, y), m, as rows of a beacon."""
        found = []
        for peer in self._known.values():
            message = peer.message
            if message is not None and SILENT_NS < now_ns + peer.clock.used_ns - peer.time_ns < HEARSAY_NS:
                square = _square((message.x, message.y), x, y)
                found.append((square, Silent(peer.robot, peer.time_ns, message.following, *message.place)))
        return tuple(silent for _, silent in sorted(found)[:SILENT_MAX])

    def _take_beacon(self, peer: Peer, beacon: Beacon) -> None:
        peer.message = HandState.placed(
            beacon.robot,
            beacon.sequence,
            beacon.time_ns,
            beacon.following,
            peer.degree,
            beacon.place,
            beacon.doubt,
        )
        peer.time_ns = beacon.time_ns
        peer.here = peer.token

    def _from_future(self, peer: Peer, time_ns: int, now_ns: int) -> bool:
        # A clock that was behind and has been set must not be refused for what it was.
        if time_ns > now_ns + FUTURE_NS_MAX and time_ns > now_ns + peer.clock.used_ns + FUTURE_NS_MAX:
            peer.ahead_ns = time_ns - now_ns
            return True
        return False

    def _take(self, peer: Peer, message: HandState, now_ns: int) -> None:
        """Makes `message` the latest hand state of its sender; it is newer than the one before."""
        time_ns, period_ns = message.time_ns, self._period_ns
        if peer.sequence != _NEVER:
            # No more can be missing than there was time for, whatever the numbers say: a mission
            # sets them to its rounds, and a sender that starts again begins at 0.
            gap = message.sequence - peer.sequence - 1
            if gap > 0:
                between = (time_ns - peer.hand_ns + period_ns // 2) // period_ns - 1
                peer.lost += max(0, min(gap, between))
        peer.received += 1
        if now_ns + peer.clock.used_ns - time_ns > 2 * period_ns:
            peer.delayed += 1
        peer.hand_ns = time_ns
        peer.sequence = message.sequence
        peer.degree = message.degree
        peer.copy = None
        for robot, value in message.multipliers:
            if robot == self._owner:
                peer.copy = value
                break
        if time_ns >= peer.time_ns:  # of one tick it says more than a beacon
            peer.time_ns = time_ns
            peer.message = message
            peer.here = peer.token

    def present(self, robot: int, here: bool) -> None:
        """Takes a change of presence: the process of a robot's agent came (`here`) or went."""
        peer = self.get(robot)
        peer.token = here
        if not here:
            peer.here = False

    def speaks_another_version(self, robot: int, what: str) -> None:
        """A message of a robot was refused for its version; `what` it and this program speak."""
        self.get(robot).other_version = what

    def take_copy(self, robot: int) -> float | None:
        """Its copy of the shared multiplier, if one has come since the last call.

        Both ends of an edge hold a copy of lambda; averaging keeps lambda_ij = lambda_ji, (31), when messages
        are lost.
        """
        peer = self._known.get(robot)
        if peer is None:
            return None
        copy, peer.copy = peer.copy, None
        return copy

    def unheard(self, robot: int) -> None:
        """Its hand states are not listened to any more: those that did not come are not lost."""
        peer = self._known.get(robot)
        if peer is not None:
            peer.sequence = _NEVER

    # ------------------------------------------------------------------ what is known

    def heard(self) -> tuple[tuple[int, int], ...]:
        """What to echo: ``(robot, least apparent delay of its hand states in us)``, where it is known."""
        if self._heard is None:
            known = [peer for peer in self._known.values() if peer.clock.least_us is not None]
            if len(known) > NEIGHBOURS_MAX:  # a message has room for no more: those that were heard last
                known = sorted(known, key=_by_hand, reverse=True)[:NEIGHBOURS_MAX]
            self._heard = tuple(sorted((peer.robot, peer.clock.least_us or 0) for peer in known))
        return self._heard

    def set_trust(self, peer: Peer, trust: float) -> None:
        """Trusts a robot so much (0..1) at once, as the one that trusts does not drive."""
        peer.trust = trust

    def update_trust(self, peer: Peer, wanted: bool, period_s: float) -> float:
        """Moves the trust in a robot (0..1) on by one tick, up if `wanted`, and returns it."""
        if wanted:
            peer.trust = min(1.0, peer.trust + period_s / TRUST_GAINED_S)
        else:
            peer.trust = max(0.0, peer.trust - period_s / TRUST_LOST_S)
        return peer.trust

    def predict(self, peer: Peer, time_ns: int) -> Prediction:
        """A robot that has been heard, carried forward to `time_ns` of the own clock.

        One whose clock is found to be ahead is further along its way, for it follows by its own. One that
        is ahead of that time is taken as it is. Without prediction its state is that of the message.

        One whose process is gone is taken to brake: its plant sees to that.
        """
        message = peer.message
        assert message is not None
        if not self._predict:
            return as_it_came(message)
        then_ns = time_ns + peer.clock.used_ns
        found = self._following(peer, message, then_ns) if message.following and peer.here else None
        return coasting(message, max(0, then_ns - message.time_ns) * 1e-9) if found is None else found

    def whereabouts(
        self, peer: Peer, time_ns: int, x: float, y: float, predicted: Prediction | None = None
    ) -> Prediction:
        """As `predict`, for one that has to be kept away from at (x, y), m; `predicted`, where that is known.

        One that has not been heard for long may follow its reference, or have stopped since: because it lost
        its neighbours, was ordered to, or hangs. One whose process seems gone may only be cut off. It
        is taken to be at the nearest point of its way.
        """
        message = peer.message
        assert message is not None
        then_ns = time_ns + peer.clock.used_ns
        age_ns = then_ns - message.time_ns
        sure = peer.here and age_ns < UNSURE_NS
        found = None
        if not sure and self._predict and message.following:
            found = self._following(peer, message, then_ns)
        if found is None:
            return predicted or self.predict(peer, time_ns)
        after = found
        nearest, least, share = found.position, _square(found.position, x, y), 1.0
        for k in range(WAY_STEPS - 1, -1, -1):
            before = self._following(peer, message, then_ns - age_ns * (WAY_STEPS - k) // WAY_STEPS) or after
            point, part = _nearest(before.position, after.position, x, y)
            square = _square(point, x, y)
            if square < least:
                nearest, least, share = point, square, part if after is found else 0.0
            after = before
        (vx, vy), (nx, ny), (fx, fy) = found.velocity, found.navigation, found.constraint
        return Prediction(
            nearest, (share * vx, share * vy), (share * nx, share * ny), (share * fx, share * fy)
        )

    def _following(self, peer: Peer, message: HandState, then_ns: int) -> Prediction | None:
        """A robot at a time of its own clock if it follows its reference, None for one without a place."""
        then = self._motion(peer.robot, then_ns)
        if then is None:
            return None
        since_ns = min(max(message.time_ns, self.epoch_ns), then_ns)
        since = self._motion(peer.robot, since_ns)
        if since is None:  # it has a place only since its message
            since = then
        age = (then_ns - since_ns) * 1e-9
        return following(message, then, since, age, self._c1, self._c2, self._decay, self._most)


def _square(point: tuple[float, float], x: float, y: float) -> float:
    dx, dy = point[0] - x, point[1] - y
    return dx * dx + dy * dy


def _nearest(
    a: tuple[float, float], b: tuple[float, float], x: float, y: float
) -> tuple[tuple[float, float], float]:
    """The point from `a` to `b` that is nearest to (x, y), and how far along it is, 0..1."""
    dx, dy = b[0] - a[0], b[1] - a[1]
    square = dx * dx + dy * dy
    if square == 0.0:
        return b, 1.0
    share = max(0.0, min(1.0, ((x - a[0]) * dx + (y - a[1]) * dy) / square))
    return (a[0] + share * dx, a[1] + share * dy), share


def _by_hand(peer: Peer) -> int:
    return peer.hand_ns


def _refuse(peer: Peer, same: bool) -> str:
    peer.duplicated += same
    return "duplicate" if same else "out_of_order"
