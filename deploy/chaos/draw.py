"""A random scenario from a seed: a whole fleet file, as tables that can be written as TOML (PURE).

What is drawn is what handfast claims to survive, and no more (docs/chaos.md says where the borders are and
why). The seed chooses a profile, a kind of scenario, and the profile draws the rest.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import count, islice
from typing import Final, NamedTuple

from agent.fleet.safety import BEACON_HORIZONS
from deploy.chaos.dice import Dice, Tables
from deploy.chaos.profiles.crowded import draw_crowded
from deploy.chaos.profiles.cut_off import draw_cut_off
from deploy.chaos.profiles.dead import draw_dead, draw_restarted
from deploy.chaos.profiles.fast import draw_fast
from deploy.chaos.profiles.late import draw_late
from deploy.chaos.profiles.low_rate import draw_low_rate
from deploy.chaos.profiles.mixed import draw_mixed
from deploy.chaos.profiles.overloaded import draw_overloaded
from deploy.chaos.profiles.reordered import draw_reordered
from deploy.chaos.profiles.rovers import draw_rovers
from deploy.chaos.profiles.scale import draw_scale

WIPED: Final = 0.3
SELDOM: Final = 0.3
"""So many fleets say where they are as seldom as large ones do..."""
SELDOM_S: Final = (0.4, 2.0)
"""...with so long between two beacons..."""
SELDOMER: Final = 0.3
"""...or with some times as long, more than is between two of who is given up that ought to speak at once."""


class Profile(NamedTuple):
    """A kind of scenario: how often it is drawn, beside the others; what it is; what draws its tables from a
    seed."""

    weight: float
    says: str
    draw: Callable[[int], Tables]


PROFILES: Final[dict[str, Profile]] = {
    "mixed": Profile(3.0, "a little of everything, within half a minute", draw_mixed),
    "cut-off": Profile(2.0, "groups that change places and do not hear each other", draw_cut_off),
    "dead": Profile(1.5, "agents that die for good, their bodies on the others' way", draw_dead),
    "restarted": Profile(1.0, "agents that start again a minute after others died", draw_restarted),
    "fast": Profile(0.8, "courses near the greatest speed, all messages late and many lost", draw_fast),
    "late": Profile(0.7, "many that cross each other's ways while messages are late", draw_late),
    "low-rate": Profile(1.5, "2 to 15 Hz", draw_low_rate),
    "scale": Profile(1.0, "places 0.3 to 10 m apart", draw_scale),
    "reordered": Profile(0.5, "formations that change while some do not hear others", draw_reordered),
    "overloaded": Profile(1.0, "processes that stand now and then amid others that go on", draw_overloaded),
    "crowded": Profile(0.5, "many in each other's places, messages late, some dead", draw_crowded),
    "rovers": Profile(0.8, "vehicles that roll on while their bridges or computers are gone", draw_rovers),
}
_LATER: Final = ("rovers", "crowded", "overloaded")
"""Each takes its seeds from all that were there before it alike, the newest first: those that are left draw
what they drew before there was it."""


def profile_of(seed: int) -> str:
    """The name in `PROFILES` of the scenario's kind."""
    weights = {name: each.weight for name, each in PROFILES.items()}
    for later in _LATER:
        share = weights[later] / sum(weights.values())
        if Dice("profile", later, seed).chance(share):
            return later
        del weights[later]
    return Dice("profile", seed).weighted(list(weights.items()))


def seeds_of(profile: str | None, first: int, number: int) -> list[int]:
    """So many seeds from `first` on, of one profile if one is named."""
    found: Iterator[int] = (seed for seed in count(first) if profile in (None, profile_of(seed)))
    return list(islice(found, number))


def draw(seed: int) -> Tables:
    """The tables of the fleet file of this scenario."""
    tables = PROFILES[profile_of(seed)].draw(seed)
    _wipe(Dice("wipe", seed), tables)
    _say_seldom(Dice("seldom", seed), tables)
    return tables


def _say_seldom(dice: Dice, tables: Tables) -> None:
    """Some fleets behave in this as those of more than `agent.fleet.safety.BEACONS_MANY` robots."""
    if dice.chance(SELDOM):
        horizon_s = tables.get("control", {}).get("prediction_horizon_s", SELDOM_S[1])
        longest_s = dice.between(SELDOM_S[0], min(SELDOM_S[1], horizon_s), 1)
        if dice.chance(SELDOMER):
            longest_s = round(BEACON_HORIZONS * longest_s, 1)
        tables.setdefault("avoidance", {})["beacon_interval_max_s"] = longest_s


def _wipe(dice: Dice, tables: Tables) -> None:
    """Some of the processes that are killed lose their disks, too: they start again without their orders."""
    for rule in tables.get("faults", {}).get("rule", ()):
        if ("kill" in rule or "restart" in rule) and dice.chance(WIPED):
            rule["wipe"] = True
