"""The fleet file by which a run is made of recordings: which it is, and whose recording has another."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from typing import Final, NamedTuple

from handfast.agent.common.wording import printable, show
from handfast.agent.fleet.loading import digest as digest_of
from handfast.agent.fleet.loading import fleet_tables, parse_fleet, to_dict
from handfast.agent.fleet.model import Fleet, FleetError, FormationError
from handfast.agent.fleet.plugin_tables import plugins_named
from handfast.agent.formation.geometry import resolved
from handfast.agent.recorder.segments import About
from handfast.deploy.merging.robot_recording import MergeError, SegmentFile

TEXTS_MAX: Final = 8
"""So many fleet files of one robot's recording are read: their texts may differ in what is no robot's affair,
and each takes its time."""


TEXT_MAX: Final = 300
SOURCE: Final = "the fleet file in it"
NOT_ITS_DIGEST: Final = f"{SOURCE} is not the one that its digest names"


class Unusable(Exception):
    """A fleet file that is not what a recording says it is; the text is a few words."""


class Ruling(NamedTuple):
    """The fleet that robots drove as, and what names its file."""

    fleet: Fleet
    digest: str


class _File(NamedTuple):
    """A fleet file that was read, and the digest that is computed of it."""

    fleet: Fleet
    digest: str


class FleetFiles:
    """The fleet files in recordings, each read once.

    A file counts if what is computed of it is the digest beside it. Where it is not, since another version of
    handfast may have computed that, it counts if most robots have the same.

    Args:
        own: the operator's own; rules where it has the digest. What it does not name no file makes this
            computer load.
    """

    def __init__(self, own: Fleet | None) -> None:
        self._own = None if own is None else resolved(own)
        self._own_digest = None if self._own is None else digest_of(self._own)
        self._plugins = frozenset() if own is None else plugins_named(to_dict(own))
        self._read: dict[str, _File | Unusable] = {}
        self._texts: dict[int, set[str]] = {}

    def ruling(self, digest: str, among: Sequence[SegmentFile]) -> Fleet | None:
        """The fleet of the file that this digest names, None where no such file is in these recordings."""
        if self._own is not None and self._own_digest == digest:
            return self._own
        of_robots = {
            (each.about.robot, each.about.fleet_toml): each.about
            for each in among
            if each.about.digest == digest
        }
        counts = Counter(text for _, text in of_robots)
        most = max(2, 1 + len({each.about.robot for each in among}) // 2)
        for about in sorted(of_robots.values(), key=lambda each: (-counts[each.fleet_toml], each.robot)):
            with suppress(Unusable):
                found = self._parsed(about)
                if found.digest == digest or counts[about.fleet_toml] >= most:
                    return found.fleet
        return None

    def choose(self, among: Sequence[SegmentFile], of_mission: str | None) -> Ruling:
        """The file that rules the run: the mission's, else the operator's own if a robot had it, else that
        of most robots.

        Raises:
            MergeError: none can be used.
        """
        newest = {each.about.robot: each.about for each in sorted(among, key=lambda each: each.first_ns)}
        counts = Counter(about.digest for about in newest.values())
        # Of as many robots each, that of the robot with the least id: no recording says when it is the later.
        order = sorted(newest, key=lambda robot: (-counts[newest[robot].digest], robot))
        claimed = [newest[robot].digest for robot in order]
        everywhere = {each.about.digest for each in among}
        first = [digest for digest in (of_mission, self._own_digest) if digest and digest in everywhere]
        for digest in dict.fromkeys([*first, *claimed]):
            if (fleet := self.ruling(digest, among)) is not None:
                return Ruling(fleet, digest)
        about = newest[order[0]]
        why = self._why_unusable(about) or NOT_ITS_DIGEST
        raise MergeError(f"no recording can be used: {self.who(about.robot)}: {why}")

    def why_not(self, about: About, ruling: Ruling) -> str | None:
        """Why a recording is no part of a run by the file that rules; None when it is one."""
        if about.digest != ruling.digest:
            return "it ran another fleet file in this time"
        return self._why_unusable(about, ruling.fleet)

    def who(self, robot: int) -> str:
        """A robot's recording, and the host that gave it, in words."""
        host = self._own.robot(robot).host if self._own is not None and robot in self._own.ids else None
        return f"what robot {robot} recorded" + (f" ({host})" if host else "")

    def _why_unusable(self, about: About, rules: Fleet | None = None) -> str | None:
        try:
            found = self._parsed(about)
        except Unusable as error:
            return str(error)
        return None if found.digest == about.digest or found.fleet == rules else NOT_ITS_DIGEST

    def _parsed(self, about: About) -> _File:
        text = about.fleet_toml
        if text not in self._read:
            texts = self._texts.setdefault(about.robot, set())
            texts.add(text)
            if len(texts) > TEXTS_MAX:
                raise Unusable(f"there are more than {TEXTS_MAX} fleet files in it")
            self._read[text] = self._parse(about)
        found = self._read[text]
        if isinstance(found, Unusable):
            raise found
        if found.fleet.fleet.name != about.fleet:
            raise Unusable(f"{SOURCE} is that of {show(found.fleet.fleet.name)}")
        return found

    def _parse(self, about: About) -> _File | Unusable:
        try:
            strangers = sorted(plugins_named(fleet_tables(about.fleet_toml, SOURCE)) - self._plugins)
            if strangers:
                return Unusable(
                    f"{SOURCE} names the plugin {show(strangers[0])}, which yours does not: it is not loaded"
                )
            fleet = resolved(parse_fleet(about.fleet_toml, source=SOURCE, recorded=True))
        except FleetError as error:
            return Unusable(printable(f"{SOURCE}: {error.problems[0]}")[:TEXT_MAX])
        except FormationError as error:
            return Unusable(printable(f"{SOURCE}: {error}")[:TEXT_MAX])
        return _File(fleet, digest_of(fleet))


def taken(
    files: FleetFiles, among: Sequence[SegmentFile], ruling: Ruling
) -> tuple[list[SegmentFile], list[str]]:
    """The recordings that a run by the ruling file is made of, and a line for each robot of which some are
    not."""
    found: list[SegmentFile] = []
    said: dict[int, str] = {}
    for segment in among:
        why = files.why_not(segment.about, ruling)
        if why is None:
            found.append(segment)
        else:
            said.setdefault(segment.about.robot, why)
    return found, [f"{files.who(robot)} is left out: {why}" for robot, why in sorted(said.items())]
