"""What robots' recordings say of the fleet as a whole, and what of it is believed.

An order counts if an operator has sealed it or, in a fleet without security, if most robots recorded it. Live
fault rules count if most robots recorded that they held them. The fleet file is the mission's, else that of
most robots. One computer can leave something out of its recording, but it cannot make an order up, nor accuse
or excuse others by made-up rules.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from statistics import median_low
from typing import Final

from handfast.agent.common.wording import printable, show
from handfast.agent.fleet.loading import digest as digest_of
from handfast.agent.fleet.loading import fleet_tables, parse_fleet, to_dict
from handfast.agent.fleet.model import Fleet, FleetError
from handfast.agent.fleet.plugin_tables import plugins_named
from handfast.agent.formation.geometry import resolved
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import decode
from handfast.agent.messages.types import Faults, Mission, Resume, Stop
from handfast.agent.messages.validation import Malformed
from handfast.agent.recorder.recorder import About, Received, order_message
from handfast.agent.security.sealed_order import Forged, Opener
from handfast.deploy.merging.robot_files import MergeError, RobotFile

DISTINCT_MAX: Final = 4096
"""Maximum number of one robot's orders that are verified, the last ones."""
SETS_MAX: Final = 1024
"""Maximum number of one robot's sets of fault rules that are compared."""
TEXTS_MAX: Final = 8
"""Maximum number of different fleet files that are read of one robot's recording."""
TEXT_MAX: Final = 300
SOURCE: Final = "the fleet file in it"

Order = Mission | Stop | Resume


def orders_given(
    recorded: Mapping[int, Iterable[bytes]], opener: Opener | None, voters: Callable[[int], int]
) -> tuple[list[Order], Counter[int]]:
    """Return the orders that count, by time, and by robot the number of orders that do not.

    Args:
        recorded: by robot, the oldest first.
        opener: of the fleet's sealed orders; None: orders count that most robots have, sealed or not.
        voters: number of robots that should know of an order that was given at a time (wall clock, ns).
    """
    times: dict[Order, dict[int, int]] = {}
    """By content, the time at which it was given by each robot's recording."""
    left_out: Counter[int] = Counter()
    for robot, payloads in recorded.items():
        distinct = list(dict.fromkeys(payloads))
        left_out[robot] += max(0, len(distinct) - DISTINCT_MAX)
        for payload in distinct[-DISTINCT_MAX:]:
            if (order := _order(payload, opener)) is None:
                left_out[robot] += 1
                continue
            said = times.setdefault(order._replace(time_ns=0), {})
            # An order is repeated, each time with the time of the repetition.
            said[robot] = min(order.time_ns, said.get(robot, order.time_ns))
    given = []
    for content, said in times.items():
        first_ns = min(said.values()) if opener is not None else median_low(said.values())
        if opener is not None or 2 * len(said) > voters(first_ns):
            given.append(content._replace(time_ns=first_ns))
        else:
            left_out.update(said.keys())
    return sorted(given, key=lambda order: (order.time_ns, order.version)), +left_out


def _order(payload: bytes, opener: Opener | None) -> Order | None:
    try:
        message = order_message(payload) if opener is None else decode(opener.open_recorded(payload).payload)
    except (Malformed, Forged):
        return None
    return message if isinstance(message, (Mission, Stop, Resume)) else None


class HeldFaults:
    """The sets of live fault rules that most of `robots` of a fleet held."""

    def __init__(self, fleet: str, robots: Iterable[int]) -> None:
        self._robots = frozenset(robots)
        self._robot_of = {
            key_expressions.faults_held(fleet, robot, role): robot
            for robot in self._robots
            for role in key_expressions.ROLES
        }
        self.keys = frozenset(self._robot_of)
        self._holders: dict[Faults | None, set[int]] = {}

    def count(self, received: Iterable[Received]) -> None:
        """Take all messages under `keys`."""
        counts: Counter[int] = Counter()
        for _, key, payload in received:
            robot, rules = self._robot_of[key], _rules(payload)
            new = rules not in self._holders
            if not new or counts[robot] < SETS_MAX:
                counts[robot] += new
                self._holders.setdefault(rules, set()).add(robot)

    def made_up_by(self, key: str, payload: bytes) -> int | None:
        """Return the robot that sent a message about rules that most robots did not hold."""
        robot, rules = self._robot_of.get(key), None
        if robot is not None and (rules := _rules(payload)) is not None:
            return None if 2 * len(self._holders.get(rules, ())) > len(self._robots) else robot
        return robot


def _rules(payload: bytes) -> Faults | None:
    """The part of a message about rules that all their holders send alike."""
    try:
        message = decode(payload)
    except Malformed:
        return None
    return message._replace(time_ns=0) if isinstance(message, Faults) else None


class FleetFiles:
    """The fleet files in recordings, each read once.

    Args:
        own: the operator's own fleet. Plugins that it does not name are not loaded.
    """

    def __init__(self, own: Fleet | None) -> None:
        self._own = None if own is None else resolved(own)
        self._plugins = frozenset() if own is None else plugins_named(to_dict(own))
        self._read: dict[str, tuple[str, Fleet | str]] = {}
        """By text, the digest that is computed of it, and the fleet or why it cannot be used."""
        self._texts: dict[int, set[str]] = {}

    def digests(self, files: Iterable[RobotFile]) -> set[str]:
        """Return the digests of the usable fleet files."""
        return {self._parsed(file.about)[0] for file in files if file.about}

    def choose(
        self, among: Sequence[RobotFile], of_mission: str | None
    ) -> tuple[Fleet, list[RobotFile], list[str]]:
        """Return the fleet of the run, the files that belong to it, and a line for each other robot.

        Raises:
            MergeError: no fleet file can be used.
        """
        newest: dict[int, str] = {}
        fleets: dict[str, Fleet] = {}
        found: list[tuple[RobotFile, str, Fleet | str]] = []
        for file in sorted(among, key=lambda file: file.first_ns):
            assert file.about is not None
            digest, fleet = self._parsed(file.about)
            found.append((file, digest, fleet))
            if isinstance(fleet, Fleet):
                newest[file.robot] = digest
                fleets.setdefault(digest, fleet)
        if not fleets:
            raise MergeError(f"no recording can be used: {self.who(found[0][0].robot)}: {found[0][2]}")
        counts = Counter(newest.values())
        ruling = min(newest, key=lambda robot: (newest[robot] != of_mission, -counts[newest[robot]], robot))
        wanted = of_mission if of_mission in fleets else newest[ruling]
        said: dict[int, str] = {}
        for file, digest, fleet in found:
            if digest != wanted:
                other = "it ran another fleet file in this time"
                said.setdefault(file.robot, fleet if isinstance(fleet, str) else other)
        lines = [f"{self.who(robot)} is left out: {why}" for robot, why in sorted(said.items())]
        return fleets[wanted or ""], [file for file, digest, _ in found if digest == wanted], lines

    def who(self, robot: int) -> str:
        """A robot's recording and its host, in words."""
        host = self._own.robot(robot).host if self._own is not None and robot in self._own.ids else None
        return f"what robot {robot} recorded" + (f" ({host})" if host else "")

    def _parsed(self, about: About) -> tuple[str, Fleet | str]:
        text = about.fleet_toml
        texts = self._texts.setdefault(about.robot, set())
        if text not in self._read:
            if len(texts) >= TEXTS_MAX:
                return "", f"there are more than {TEXTS_MAX} fleet files in it"
            self._read[text] = self._parse(text)
        texts.add(text)
        digest, fleet = self._read[text]
        if isinstance(fleet, Fleet) and fleet.fleet.name != about.fleet:
            return "", f"{SOURCE} is that of {show(fleet.fleet.name)}"
        return digest, fleet

    def _parse(self, text: str) -> tuple[str, Fleet | str]:
        try:
            if strangers := sorted(plugins_named(fleet_tables(text, SOURCE)) - self._plugins):
                plugin = show(strangers[0])
                return "", f"{SOURCE} names the plugin {plugin}, which yours does not: it is not loaded"
            fleet = resolved(parse_fleet(text, source=SOURCE, recorded=True))
        except FleetError as error:
            return "", printable(f"{SOURCE}: {error.problems[0]}")[:TEXT_MAX]
        digest = digest_of(fleet)
        # What is not in the digest, such as addresses, is as the operator's own has it.
        if self._own is None or digest != digest_of(self._own):
            return digest, fleet
        return digest, self._own
