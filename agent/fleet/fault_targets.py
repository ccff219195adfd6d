"""Targets of faults: sets of directed links, and partitions of a fleet (PURE)."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, cast

from handfast.agent.common.wording import show

_IDS = r"\*|[0-9]{1,4}(?:\s*,\s*[0-9]{1,4})*"
_LINK = re.compile(rf"\s*({_IDS})\s*(<->|->)\s*({_IDS})\s*")


@dataclass(frozen=True, slots=True)
class LinkSet:
    """A set of directed links: pairs of (sources, destinations), None standing for every robot."""

    pairs: tuple[tuple[tuple[int, ...] | None, tuple[int, ...] | None], ...]

    @classmethod
    def parse(cls, raw: object) -> LinkSet:
        """``"1->2"``, ``"1<->2"``, ``"1,2->3"``, ``"*->3"``; several in an array, or with ``;`` between them.

        Raises:
            ValueError: anything else, with the text that is wrong.
        """
        texts = raw.split(";") if isinstance(raw, str) else raw
        if not isinstance(texts, (list, tuple)) or not texts:
            raise ValueError(f'must be a link such as "1->2", "1<->2", "1,2->3" or "*->3", got {show(raw)}')
        pairs: list[tuple[tuple[int, ...] | None, tuple[int, ...] | None]] = []
        for text in texts:
            match = _LINK.fullmatch(text) if isinstance(text, str) and len(text) < 2000 else None
            if match is None:
                raise ValueError(
                    f'must be a link such as "1->2", "1<->2", "1,2->3" or "*->3", got {show(text)}'
                )
            left, right = _ids(match[1]), _ids(match[3])
            pairs.append((left, right))
            if match[2] == "<->":
                pairs.append((right, left))
        return cls(tuple(pairs))

    def __str__(self) -> str:
        shown = ("*" if ids is None else ",".join(map(str, ids)) for pair in self.pairs for ids in pair)
        return "; ".join(f"{source}->{destination}" for source, destination in zip(shown, shown, strict=True))

    @property
    def ends(self) -> tuple[int, int] | None:
        """Source and destination when it is one link, else None."""
        if len(self.pairs) == 1 and all(ids is not None and len(ids) == 1 for ids in self.pairs[0]):
            (source, destination), *_ = self.pairs
            return (source or (0,))[0], (destination or (0,))[0]
        return None

    def named(self) -> set[int]:
        """Every robot that is named."""
        return {robot for pair in self.pairs for ids in pair if ids is not None for robot in ids}

    def has(self, source: int, destination: int) -> bool:
        """Whether the link from `source` to `destination` is one of them."""
        return any(
            (sources is None or source in sources) and (destinations is None or destination in destinations)
            for sources, destinations in self.pairs
        )


def _ids(text: str) -> tuple[int, ...] | None:
    return None if text == "*" else tuple(sorted({int(part) for part in text.split(",")}))


@dataclass(frozen=True, slots=True)
class Partition:
    """Who hears whom no more: ``groups`` apart, one robot ``alone``, a ``bridge``, ring of ``majorities``.

    The kinds are those of Jepsen's nemeses (Kingsbury). `groups` holds the groups, or the robot that is
    alone or the bridge.
    """

    kind: Literal["groups", "alone", "bridge", "majorities"]
    groups: tuple[tuple[int, ...], ...] = ()

    @classmethod
    def parse(cls, raw: object) -> Partition:
        """``"1,2,3 | 4,5,6"``, ``"alone 4"``, ``"bridge 3"`` or ``"majorities"``.

        Raises:
            ValueError: anything else.
        """
        wrong = (
            'must be groups such as "1,2,3 | 4,5,6", "alone 4", "bridge 3" or "majorities", '
            f"got {show(raw)} (one way only: write a link such as \"1,2->3,4\" with loss = '100%')"
        )
        if not isinstance(raw, str) or len(raw) > 4000:
            raise ValueError(wrong)
        words = raw.split()
        if words == ["majorities"]:
            return cls("majorities")
        if len(words) == 2 and words[0] in ("alone", "bridge") and re.fullmatch(r"[0-9]{1,4}", words[1]):
            return cls(cast(Literal["alone", "bridge"], words[0]), ((int(words[1]),),))
        groups = []
        for part in raw.split("|"):
            if not re.fullmatch(r"\s*[0-9]{1,4}(\s*,\s*[0-9]{1,4})*\s*", part):
                raise ValueError(wrong)
            groups.append(tuple(sorted({int(text) for text in part.split(",")})))
        if len(groups) < 2:
            raise ValueError(wrong)
        flat = [robot for group in groups for robot in group]
        twice = sorted({robot for robot in flat if flat.count(robot) > 1})
        if twice:
            raise ValueError(
                f"robot {twice[0]} is in two groups of {show(raw)}: groups must not share robots"
            )
        return cls("groups", tuple(groups))

    def __str__(self) -> str:
        if self.kind == "groups":
            return " | ".join(",".join(map(str, group)) for group in self.groups)
        return self.kind if not self.groups else f"{self.kind} {self.groups[0][0]}"

    def named(self) -> set[int]:
        """Every robot that is named."""
        return {robot for group in self.groups for robot in group}

    def cuts(self, source: int, destination: int, ids: Sequence[int]) -> bool:
        """Whether `destination` does not hear `source`; `ids` are the fleet's, from which halves are made."""
        if self.kind == "groups":
            group = {robot: number for number, members in enumerate(self.groups) for robot in members}
            return source in group and destination in group and group[source] != group[destination]
        if self.kind == "alone":
            return (source in self.groups[0]) != (destination in self.groups[0])
        ring = sorted(ids)
        if self.kind == "bridge":
            rest = [robot for robot in ring if robot not in self.groups[0]]
            if source not in rest or destination not in rest:
                return False
            half = (len(rest) + 1) // 2
            return (rest.index(source) < half) != (rest.index(destination) < half)
        # Each robot hears the majority that lies around it on the ring of ids: no two hear the same one.
        count, others = len(ring), len(ring) // 2
        away = (ring.index(source) - ring.index(destination)) % count
        return not (away <= (others + 1) // 2 or away >= count - others // 2)
