"""Every oracle fires where something is as it must never be, and is silent or does not apply elsewhere."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

import pytest

from handfast.agent.fleet.fault_rules import ClockError, Effect, FaultsSection, Partition, Rule, TickJitter
from handfast.agent.fleet.hosts import HostSection
from handfast.agent.fleet.model import Fleet
from handfast.agent.fleet.safety import AvoidanceSection, GeofenceSection, ObstacleSection
from handfast.agent.fleet.sections import ControlSection
from handfast.agent.formation.geometry import resolve
from handfast.agent.impairments.impairments import Delay
from handfast.agent.impairments.loss_models import Loss
from handfast.agent.messages import key_expressions
from handfast.agent.messages.types import (
    Decision,
    Event,
    LinkTrace,
    Message,
    Mission,
    PlantState,
    Resume,
    Status,
    Stop,
    Wrench,
)
from handfast.deploy.analysis.analysis import analyse
from handfast.deploy.recording.collector import RunData
from handfast.deploy.recording.recording import Recording
from handfast.deploy.verdict.oracles import ORACLES, examine
from handfast.deploy.verdict.oracles_drive import formed_by_s
from handfast.deploy.verdict.violations import Violation
from tests.unit.deploy.synthetic_run import EPOCH_NS, Sent, make_fleet, messages, standing, triangle
from tests.unit.deploy.synthetic_run import Path as Way

PAIR = make_fleet([(0.0, 0.0), (1.0, 0.0)], [(1, 2)], duration_s=4.0)
TRIO = make_fleet(*triangle(2), duration_s=4.0)
LONG = make_fleet([(0.0, 0.0), (1.0, 0.0)], [(1, 2)], duration_s=30.0, rate_hz=10.0)
NAME = PAIR.fleet.name
Change = Callable[[float, Any], Message | None]
"""Fleet time and a message of a good run -> what was sent instead."""


def ns(t: float) -> int:
    return EPOCH_NS + round(t * 1e9)


def hand(path: Way) -> Way:
    """The body whose hand point is there; its heading is 0."""
    return lambda t: (path(t)[0] - 0.1, path(t)[1], 0.0)


def recorded(
    fleet: Fleet, *paths: Way, change: Change = lambda t, m: m, extra: Iterable[Sent] = ()
) -> Recording:
    """A run with hand points on these paths, each message changed, and others besides."""
    data = RunData(fleet)
    for received, key, message in messages(fleet, [hand(path) for path in paths]):
        sent = change((message.time_ns - EPOCH_NS) / 1e9, message)
        if sent is not None:
            data.feed(received, key, sent)
    for each in extra:
        data.feed(*each)
    return data.recording()


def examined(recording: Recording) -> dict[str, list[Violation] | None]:
    fleet = recording.fleet
    return examine(recording, analyse(recording, resolve(fleet)), fleet)


def found(oracle: str, fleet: Fleet, *paths: Way, **options: Any) -> list[str] | None:
    """What one oracle says; no other one says anything."""
    results = examined(recorded(fleet, *(paths or _in_place(fleet)), **options))
    assert {name for name, violations in results.items() if violations} <= {oracle}
    violations = results[oracle]
    return None if violations is None else [violation.message for violation in violations]


def _in_place(fleet: Fleet) -> list[Way]:
    return [standing(x, y) for x, y in fleet.formation.offsets or ()]


def event(t: float, robot: int, role: str, what: str) -> Sent:
    return ns(t), key_expressions.events(NAME), Event(robot, round(t * 1000), ns(t), role, what, "rule")


def test_a_good_run_violates_nothing_and_most_does_not_apply() -> None:
    recording = recorded(PAIR, *_in_place(PAIR))
    results = examined(recording)
    assert list(results) == [oracle.name for oracle in ORACLES]
    assert {name for name, violations in results.items() if violations is not None} == {
        "separation", "one_mission", "limits",
    }  # fmt: skip
    assert not any(examine(recording, analyse(recording, resolve(PAIR)), PAIR).values())


# --- places -------------------------------------------------------------------------------------


def test_separation_of_a_pair_with_an_edge() -> None:
    def dips(t: float) -> tuple[float, float, float]:
        return 0.2 if abs(t - 2.0) < 0.001 else 1.0, 0.0, 0.0

    assert found("separation", PAIR, standing(0, 0), dips) == [
        "Robots 1 and 2, which share an edge, came within 0.200 m of each other at 2.00 s; the safe distance "
        "is 0.220 m."
    ]


def test_separation_of_a_pair_without_an_edge_whatever_the_law_promises() -> None:
    line = make_fleet([(0, 0), (1, 0), (2, 0)], [(1, 2), (2, 3)], duration_s=4.0)

    def dips(t: float) -> tuple[float, float, float]:
        return 0.0 if abs(t - 2.0) < 0.001 else 2.0, 0.1, 0.0

    paths = standing(0, 0), standing(1, 0), dips
    (sentence,) = found("separation", line, *paths) or []
    assert sentence.startswith("Robots 1 and 3, which share no edge, came within 0.100 m")
    bare = replace(line, avoidance=AvoidanceSection(enabled=False))
    assert found("separation", bare, *paths) == [
        f"{sentence} With avoidance.enabled = false nothing keeps such pairs apart."
    ]


def of_rovers(recording: Recording) -> dict[str, list[Violation] | None]:
    """What is found of a run in virtual time of rovers, of which all is known."""
    robots = tuple(replace(robot, plant="mavlink") for robot in recording.fleet.robots)
    return examined(replace(recording, fleet=replace(recording.fleet, robots=robots), mode="simulate"))


def test_what_came_near_while_nothing_steered_it_is_told_as_that() -> None:
    """Two rovers of which one rolls on; the other one has its bridge, and its agent, or it has not."""
    lost = event(0.5, 2, "plant", "kill")

    def dips(t: float) -> tuple[float, float, float]:
        return 0.15 if abs(t - 2.0) < 0.001 else 1.0, 0.0, 0.0

    def judged(*events: Sent) -> Violation:
        (violation,) = of_rovers(recorded(PAIR, standing(0, 0), dips, extra=events))["separation"] or ()
        return violation

    near = (
        "Robots 1 and 2, which share an edge, came within 0.150 m of each other at 2.00 s; the safe distance "
        "is 0.220 m."
    )
    assert judged(lost) == Violation("separation", 2.0, near)
    for other in ("agent", "plant"):
        found = judged(lost, event(1.0, 1, other, "kill"))
        assert found == Violation("separation", 2.0, f"{near} Nothing steered either of them.", False)
    found = judged(lost, event(1.0, 1, "agent", "kill"), event(2.005, 1, "agent", "start"))
    assert not found.avoidable, "when it was back they were further apart"
    assert judged(event(0.5, 2, "agent", "kill"), event(0.5, 1, "agent", "kill")).avoidable, "they brake"


def test_separation_of_a_pair_that_passes_between_two_samples() -> None:
    slow = make_fleet([(-4.0, 0.1), (4.0, 0.0)], [(1, 2)], duration_s=4.0, rate_hz=2.0)

    def there(t: float) -> tuple[float, float, float]:
        return -4.3 + 2.0 * t, 0.1, 0.0  # at 2.15 s in the middle, 0.3 m beside it at 2.0 s

    def back(t: float) -> tuple[float, float, float]:
        return 4.3 - 2.0 * t, 0.0, 0.0

    results = examined(recorded(slow, there, back))
    (violation,) = results["separation"] or ()
    assert "came within 0.100 m of each other at 2.00 s" in violation.message


def test_who_begins_too_close_is_excused_until_first_apart() -> None:
    def leaves(t: float) -> tuple[float, float, float]:
        return (0.1 if t < 0.5 else 1.0), 0.0, 0.0

    def returns(t: float) -> tuple[float, float, float]:
        return (0.1 if t < 0.5 else 0.15 if 2.0 < t < 2.05 else 1.0), 0.0, 0.0

    assert found("separation", PAIR, standing(0, 0), leaves) == []
    (sentence,) = found("separation", PAIR, standing(0, 0), returns) or []
    assert "within 0.150 m of each other at 2.02 s" in sentence
    results = examined(recorded(PAIR, standing(0, 0), standing(0.1, 0)))  # never apart
    assert len(results["separation"] or ()) == 1


def with_obstacle(enabled: bool = True) -> Fleet:
    return replace(
        PAIR,
        obstacles=(ObstacleSection(name="shed", centre_m=(0.0, 3.0), radius_m=1.0),),
        avoidance=AvoidanceSection(enabled=enabled, clearance_m=0.3),
    )


@pytest.mark.parametrize(
    ("y", "sentence"),
    [
        (1.65, None),
        (1.695, None),  # within a centimetre of the clearance
        (1.8, "Robot 1 came within 0.200 m (at least 0.300 m) of shed at 2.00 s."),
        (2.25, "Robot 1 was 0.250 m inside shed at 2.00 s."),
    ],
)
def test_clearance(y: float, sentence: str | None) -> None:
    def at(t: float) -> tuple[float, float, float]:
        return 0.0, y if abs(t - 2.0) < 0.001 else 0.0, 0.0

    wanted = [] if sentence is None else [sentence]
    assert found("clearance", with_obstacle(), at, standing(1, 0)) == wanted
    bare = [] if sentence is None or "inside" not in sentence else [sentence]
    assert found("clearance", with_obstacle(enabled=False), at, standing(1, 0)) == bare


def test_clearance_excuses_who_begins_there_and_who_is_driven_by_another() -> None:
    def leaves(t: float) -> tuple[float, float, float]:
        return (0.0, 2.5, 0.0) if t < 1.0 else (0.0, 0.0, 0.0)

    assert found("clearance", with_obstacle(), leaves, standing(1, 0)) == []
    fleet = with_obstacle()
    first, second = fleet.robots
    for reserve, fires in ((False, True), (True, False)):  # who stays there though its place is elsewhere
        spare = replace(fleet, robots=(replace(first, reserve=reserve), second))
        if reserve:
            spare = replace(spare, formation=replace(spare.formation, edges=(), offsets=((1.0, 0.0),)))
        assert bool(found("clearance", spare, standing(0, 1.9), standing(1, 0))) == fires

    def visits(t: float) -> tuple[float, float, float]:
        return (0.0, 2.5, 0.0) if 2.2 < t < 2.8 else (0.0, 0.0, 0.0)

    def released(t: float, m: Message) -> Message:
        is_free = type(m) is Status and m.robot == 1 and 1.9 < t < 3.1
        return m._replace(state="released") if is_free and type(m) is Status else m

    assert found("clearance", with_obstacle(), visits, standing(1, 0), change=released) == []
    assert found("clearance", with_obstacle(), visits, standing(1, 0))


def test_a_rover_that_nothing_commands_is_told_to_be_where_it_rolled_to() -> None:
    def rolls(t: float) -> tuple[float, float, float]:
        return (0.0, 2.25, 0.0) if abs(t - 2.0) < 0.001 else (0.0, 0.0, 0.0)

    lost = event(0.5, 1, "plant", "kill")
    (violation,) = (
        of_rovers(recorded(with_obstacle(), rolls, standing(1, 0), extra=[lost]))["clearance"] or ()
    )
    said = "Robot 1 was 0.250 m inside shed at 2.00 s. Nothing commanded it."
    assert violation == Violation("clearance", 2.0, said, False)
    late = event(2.1, 1, "plant", "kill")
    (violation,) = (
        of_rovers(recorded(with_obstacle(), rolls, standing(1, 0), extra=[late]))["clearance"] or ()
    )
    assert violation.avoidable
    fled = recorded(FENCED, _outside(3.5, 1.5, 3.0), standing(0, 0), extra=[lost])
    outside = of_rovers(fled)["geofence"] or ()
    assert {violation.avoidable for violation in outside} == {False}
    assert all(violation.message.endswith("Nothing commanded it.") for violation in outside)


FENCED = replace(PAIR, geofence=GeofenceSection(((-2.0, -2.0), (2.0, -2.0), (2.0, 2.0), (-2.0, 2.0))))


def _outside(x: float, begin_s: float, end_s: float) -> Way:
    return lambda t: (x if begin_s < t < end_s else 1.0, 0.0, 0.0)


def _holds(t: float, m: Message) -> Message:
    return m._replace(state="holding") if type(m) is Status and m.robot == 2 and t > 1.5 else m


def test_geofence() -> None:
    still = standing(0, 0)
    assert found("geofence", FENCED, still, _outside(2.2, 1.0, 1.9)) == []
    assert found("geofence", FENCED, still, _outside(2.2, 1.0, 3.5)) == [
        "Robot 2 went on driving outside the geofence, from 1.02 s on."
    ]
    assert found("geofence", FENCED, still, _outside(2.2, 1.0, 3.5), change=_holds) == []
    (sentence,) = found("geofence", FENCED, still, _outside(4.0, 1.0, 1.5)) or []
    assert sentence.startswith("Robot 2 was 2.00 m outside the geofence at 1.02 s: braking takes 0.")
    assert found("geofence", PAIR, still, _outside(4.0, 1.0, 1.5)) is None


def test_geofence_excuses_who_begins_outside_and_who_is_driven_by_another() -> None:
    still = standing(0, 0)
    assert found("geofence", FENCED, still, _outside(4.0, -1.0, 1.5)) == []
    taken = saying(2, "released", 0.7, 2.3)
    assert found("geofence", FENCED, still, _outside(4.0, 1.0, 2.0), change=taken) == []
    assert found("geofence", FENCED, still, _outside(4.0, 1.0, 2.0))


# --- processes ----------------------------------------------------------------------------------


def knowing(begin_s: float, version: int) -> Change:
    """From `begin_s` on all agents say that they have a stop."""

    def change(t: float, m: Message) -> Message:
        return m._replace(order_version=version) if type(m) is Status and t >= begin_s else m

    return change


def braking(robot: int, begin_s: float, end_s: float = 9.0) -> Change:
    """The plant of a robot brakes from `begin_s` to `end_s`, and stands."""

    def change(t: float, m: Message) -> Message:
        if type(m) is PlantState and m.robot == robot and begin_s < t < end_s:
            return m._replace(driving=False, speed=0.0, yaw_rate=0.0)
        return m

    return change


@pytest.mark.parametrize("what", ["kill", "stop"])
def test_agent_dead(what: str) -> None:
    gone = [event(1.0, 2, "agent", what)]
    (sentence,) = found("agent_dead", PAIR, extra=gone) or []
    done = "killed" if what == "kill" else "paused"
    assert sentence == (
        f"The plant of robot 2 drove at 1.32 s: its agent was {done} at 1.00 s, and 0.30 s later it must "
        "brake."
    )
    assert found("agent_dead", PAIR, extra=gone, change=braking(2, 1.2)) == []
    late = found("agent_dead", PAIR, extra=gone, change=braking(2, 1.2, 2.5)) or []
    assert "drove at 2.5" in late[0]
    back = [event(2.4, 2, "agent", "start" if what == "kill" else "continue")]
    assert found("agent_dead", PAIR, extra=[*gone, *back], change=braking(2, 1.2, 2.5)) == []
    assert found("agent_dead", PAIR) is None


def test_agent_dead_where_ticks_come_late() -> None:
    late = replace(PAIR, faults=FaultsSection(rules=(Rule(tick_jitter=TickJitter(0.4)),)))
    gone = [event(1.0, 2, "agent", "kill")]
    assert found("agent_dead", late, extra=gone, change=braking(2, 1.6)) == []
    assert found("agent_dead", PAIR, extra=gone, change=braking(2, 1.6))


def saying(robot: int, state: str, begin_s: float, end_s: float = 9.0, reason: str = "") -> Change:
    def change(t: float, m: Message) -> Message | None:
        if type(m) is Status and m.robot == robot and begin_s < t < end_s:
            return m._replace(state=state, reason=reason)
        return m

    return change


def test_plant_dead() -> None:
    gone = [event(1.0, 2, "plant", "kill")]
    (sentence,) = found("plant_dead", PAIR, extra=gone) or []
    assert sentence.startswith("The agent of robot 2 went on driving at 1.")
    assert "its plant was killed at 1.00 s" in sentence
    for state in ("fault", "waiting"):
        assert found("plant_dead", PAIR, extra=gone, change=saying(2, state, 1.1)) == []
    assert found("plant_dead", PAIR, extra=gone, change=saying(2, "fault", 1.1, 3.0))
    back = event(2.5, 2, "plant", "start")
    assert found("plant_dead", PAIR, extra=[*gone, back], change=saying(2, "fault", 1.1, 3.0)) == []
    quick = event(1.1, 2, "plant", "start")
    assert found("plant_dead", PAIR, extra=[*gone, quick]) == []
    assert found("plant_dead", PAIR) is None


def test_plant_dead_excuses_an_agent_that_is_gone_too() -> None:
    gone = [event(1.0, 2, "plant", "kill"), event(1.0, 2, "agent", "stop")]

    def silent(t: float, m: Message) -> Message | None:
        return None if getattr(m, "robot", 0) == 2 and t > 1.0 else m

    assert found("plant_dead", PAIR, extra=gone, change=silent) == []


# --- orders -------------------------------------------------------------------------------------


def stop(t: float, version: int = 1) -> Sent:
    return ns(t), key_expressions.stop(NAME), Stop(version, ns(t), "now")


def resume(t: float, version: int, *robots: int) -> Sent:
    return ns(t), key_expressions.resume(NAME), Resume(version, ns(t), robots)


def both(*changes: Change) -> Change:
    def change(t: float, m: Message) -> Message | None:
        for each in changes:
            sent = each(t, m)
            if sent is None:
                return None
            m = sent
        return m

    return change


def test_stopped() -> None:
    brakes = both(braking(1, 1.1), braking(2, 1.1))
    assert found("stopped", PAIR, extra=[stop(1.0)], change=brakes) == []
    assert found("stopped", PAIR, extra=[stop(1.0)], change=braking(1, 1.1)) == [
        "The plant of robot 2 drove at 1.22 s, 0.22 s after the stop at 1.00 s: it must brake after 0.20 s, "
        "until a resume."
    ]
    on_hosts = replace(PAIR, hosts=(HostSection("one"),))
    slowly = both(braking(1, 1.9), braking(2, 1.9))
    assert found("stopped", on_hosts, extra=[stop(1.0)], change=slowly) == []
    assert found("stopped", on_hosts, extra=[stop(0.8)], change=slowly)
    knew = both(slowly, knowing(1.3, 7))  # what came in time is obeyed in time
    assert found("stopped", on_hosts, extra=[stop(1.0, 7)], change=knew)
    knew = both(braking(1, 1.4), braking(2, 1.4), knowing(1.3, 7))
    assert found("stopped", on_hosts, extra=[stop(1.0, 7)], change=knew) == []
    again = both(braking(1, 1.1, 2.5), braking(2, 1.1, 2.5))
    assert found("stopped", PAIR, extra=[stop(1.0, 5)], change=again)
    assert found("stopped", PAIR, extra=[stop(1.0, 5), resume(2.4, 6)], change=again) == []
    assert found("stopped", PAIR, extra=[stop(1.0, 5), resume(2.4, 4)], change=again)
    only_1 = found("stopped", PAIR, extra=[stop(1.0, 5), resume(2.4, 6, 1)], change=again) or []
    assert [sentence[:23] for sentence in only_1] == ["The plant of robot 2 dr"]
    assert found("stopped", PAIR) is None


def test_stopped_waits_for_what_is_delayed_on_purpose() -> None:
    trace = LinkTrace(2, 0, ns(1.0), (Decision(2, 2, 8, ns(1.0), 0, 500_000),))
    delayed = (ns(1.0), key_expressions.plant_links(NAME, 2), trace)
    late = both(braking(1, 1.1), braking(2, 1.6))
    assert found("stopped", PAIR, extra=[stop(1.0)], change=late)
    assert found("stopped", PAIR, extra=[stop(1.0), delayed], change=late) == []


def test_what_one_robot_says_of_its_delays_does_not_excuse_another() -> None:
    """Nor does what it says in the name of the other."""
    late = both(braking(1, 1.1), braking(2, 1.6))
    for robot, key in ((1, 1), (2, 1)):
        trace = LinkTrace(robot, 0, ns(1.0), (Decision(robot, 2, 8, ns(1.0), 0, 500_000),))
        delayed = (ns(1.0), key_expressions.plant_links(NAME, key), trace)
        (sentence,) = found("stopped", PAIR, extra=[stop(1.0), delayed], change=late) or []
        assert sentence.startswith("The plant of robot 2 drove at 1.22 s")


def test_a_stop_from_before_the_drive_holds_for_whom_it_still_held() -> None:
    """Robots that came up after it know nothing of it: it is none of this drive's."""

    def drove_on(**options: Any) -> list[str]:
        violations = examined(recorded(PAIR, *_in_place(PAIR), **options))["stopped"]
        return [violation.message for violation in violations or ()]

    before = stop(-9.0, 7)
    assert drove_on(extra=[before]) == []
    known = drove_on(extra=[before], change=knows(2, order_version=7))
    assert [sentence[:28] for sentence in known] == ["The plant of robot 2 drove a"]
    lifted = [before, resume(-0.3, 8)]
    assert (
        found(
            "stopped", PAIR, extra=lifted, change=both(knows(1, order_version=8), knows(2, order_version=8))
        )
        == []
    )
    # What it hears of later orders says nothing of that one.
    later = both(
        lambda t, m: m._replace(order_version=9) if type(m) is Status and t > 2.0 else m,
        braking(1, 2.1),
        braking(2, 2.1),
    )
    assert drove_on(extra=[before, stop(2.0, 9)], change=later) == []
    drives_on = drove_on(extra=[before, stop(1.0, 9)], change=later)
    assert len(drives_on) == 2
    assert all("after the stop at 1.00 s" in sentence for sentence in drives_on)


def test_how_late_it_braked_before_the_drive_is_none_of_this_drives() -> None:
    """The drive that the stop ended has it in its own verdict."""

    def drive_from_1_s(t: float, m: Message) -> Message:
        return m._replace(time_ns=ns(1.0)) if type(m) is Mission else m

    def until(end_s: float) -> list[str]:
        knew = both(knows(1, order_version=7), knows(2, order_version=7))
        late = both(drive_from_1_s, knew, braking(1, end_s), braking(2, -0.5))
        return found("stopped", PAIR, extra=[stop(0.0, 7)], change=late) or []

    assert until(0.9) == []
    (sentence,) = until(1.5)
    assert sentence.startswith("The plant of robot 1 drove at 1.02 s, 1.02 s after the stop at 0.00 s")


def test_stopped_robots_stand() -> None:
    def rolls(t: float, m: Message) -> Message:
        return m._replace(driving=False, speed=0.2) if type(m) is PlantState and t > 1.1 else m

    (one, two) = found("stopped", PAIR, extra=[stop(1.0)], change=rolls) or []
    assert one.startswith("Robot 1 still moved at 1.7")
    assert two.startswith("Robot 2 still moved at 1.7")

    def taken(t: float, m: Message) -> Message:
        return m._replace(obeying=False) if type(m) is PlantState and t > 1.1 else m

    assert found("stopped", PAIR, extra=[stop(1.0)], change=both(rolls, taken)) == []


def test_stopped_robots_may_roll_on_while_their_plants_are_down() -> None:
    def rolls(t: float, m: Message) -> Message:
        if type(m) is PlantState and t > 1.1:
            return m._replace(driving=False, speed=0.2 if m.robot == 2 and t < 2.6 else 0.0)
        return m

    down = [event(1.0, 2, "plant", "stop"), event(2.4, 2, "plant", "continue")]
    frozen = both(rolls, saying(2, "fault", 1.0))
    assert found("stopped", PAIR, extra=[stop(1.0)], change=frozen)
    assert found("stopped", PAIR, extra=[stop(1.0), *down], change=frozen) == []


def knows(robot: int, **versions: int) -> Change:
    return lambda t, m: m._replace(**versions) if type(m) is Status and m.robot == robot else m


def test_one_mission() -> None:
    assert found("one_mission", PAIR) == []
    assert found("one_mission", PAIR, change=knows(2, mission_version=0)) == [
        "At 4.0 s not all had acknowledged the same mission: robot 2 had version 0, the newest is 1."
    ]
    assert found("one_mission", PAIR, change=knows(1, order_version=3)) == [
        "At 4.0 s not all had acknowledged the same last stop or resume: robot 2 had version 0, the newest "
        "is 3."
    ]
    # One alone that claims more makes no others late.
    alone = found("one_mission", TRIO, change=knows(2, order_version=10**9)) or []
    assert [sentence.partition(": robot ")[2] for sentence in alone] == [
        "2 had version 1000000000, the newest is 0."
    ]
    ahead = found("one_mission", TRIO, change=knows(2, mission_version=10**9)) or []
    assert [sentence.partition(": robot ")[2] for sentence in ahead] == [
        "2 had version 1000000000, the newest is 1."
    ]
    nobody = both(knows(1, mission_version=0), knows(2, mission_version=0))
    assert len(found("one_mission", PAIR, change=nobody) or []) == 1


def test_one_mission_excuses_news_cut_links_and_agents_that_are_gone() -> None:
    behind = knows(2, mission_version=0)
    brakes = both(behind, braking(1, 0.0), braking(2, 0.0))
    news = [resume(2.0, 9), event(3.9, 1, "agent", "kill")]
    assert found("one_mission", PAIR, extra=news[:1], change=brakes) is None
    cut = Rule(link=None, robot=2, loss=Effect(Loss.parse("100%")), at=1.0, duration=1.0)
    healed = replace(PAIR, faults=FaultsSection(rules=(cut,)))
    assert found("one_mission", healed, change=behind) is None
    for kwargs, silent in (
        ({"loss": Effect(Loss.parse("30%"))}, False),
        ({"loss": Effect(Loss.parse("0%"), Loss.parse("60%"))}, True),
        ({"delay": Effect(Delay.parse("100ms 20ms"))}, False),
        ({"delay": Effect(Delay.parse("600ms"))}, True),
        ({"partition": Partition.parse("1 | 2")}, True),
    ):
        faulty = replace(PAIR, faults=FaultsSection(rules=(Rule(at=1.0, **kwargs),)))
        assert (found("one_mission", faulty, change=behind) is None) == silent, kwargs
    everywhere = replace(PAIR, faults=FaultsSection(loss=Effect(Loss.parse("60%"))))
    assert found("one_mission", everywhere, change=behind) is None
    long_ago = replace(LONG, faults=FaultsSection(rules=(cut,)))
    assert found("one_mission", long_ago, change=behind)

    def mute(t: float, m: Message) -> Message | None:
        return None if type(m) is Status and m.robot == 2 and t > 2.5 else m

    assert found("one_mission", PAIR, change=both(behind, mute)) == []
    gone = [event(2.0, 2, "agent", "kill"), event(2.5, 2, "agent", "start")]
    assert found("one_mission", PAIR, extra=gone, change=both(behind, braking(2, 2.0))) == []


# --- the drive ----------------------------------------------------------------------------------


def fast(speed: float, begin_s: float, end_s: float) -> Change:
    def change(t: float, m: Message) -> Message:
        if type(m) is PlantState and m.robot == 1 and begin_s < t < end_s:
            return m._replace(speed=speed, yaw_rate=0.0)
        return m

    return change


def test_limits_of_speed() -> None:
    assert found("limits", PAIR, change=fast(1.7, 1.0, 3.0)) == []
    assert found("limits", PAIR, change=fast(1.8, 1.0, 1.5)) == []
    assert found("limits", PAIR, change=fast(1.8, 1.0, 2.0)) == [
        "The hand of robot 1 was faster than 1.75 m/s from 1.02 s on, up to 1.80 m/s: control.max_speed_mps "
        "is 1.5."
    ]
    spins = both(fast(0.0, 1.0, 2.0), lambda t, m: m._replace(yaw_rate=20.0) if type(m) is PlantState else m)
    assert len(found("limits", PAIR, change=spins) or []) == 2  # a hand goes round its body
    taken = both(fast(1.8, 1.0, 2.0), lambda t, m: m._replace(obeying=False) if type(m) is PlantState else m)
    assert found("limits", PAIR, change=taken) == []
    bare = replace(PAIR, avoidance=AvoidanceSection(enabled=False))
    assert found("limits", bare, change=fast(1.8, 1.0, 2.0)) is None


def test_limits_of_commands() -> None:
    robots = tuple(replace(robot, max_force_n=12.0, max_torque_nm=1.5) for robot in PAIR.robots)
    limited = replace(PAIR, robots=robots)
    assert found("limits", limited) == []

    def asks(t: float, m: Message) -> Message:
        return m._replace(force=-12.5) if type(m) is Wrench and m.robot == 2 and t > 2.0 else m

    assert found("limits", limited, change=asks) == [
        "The agent of robot 2 asked for a force of -12.5 N at 2.02 s: its body can give 12."
    ]
    assert found("limits", PAIR, change=asks) == []


FAULT = Rule(robot=1, jump_m=0.1, at=2.0, duration=1.0)
FAULTY = replace(LONG, faults=FaultsSection(rules=(FAULT,)))


def _displaced(begin_s: float, end_s: float) -> Way:
    return lambda t: (1.2 if begin_s < t < end_s else 1.0, 0.0, 0.0)


def test_recovery_of_edges() -> None:
    still = standing(0, 0)
    assert found("recovery", FAULTY, still, _displaced(2.0, 22.9)) == []
    assert found("recovery", FAULTY, still, _displaced(2.0, 25.05)) == [
        "Robots 1 and 2 were 1.200 m apart instead of 1.000 m at 25.0 s: the last fault or change was at 3.0 "
        "s."
    ]
    assert found("recovery", LONG, still, _displaced(2.0, 25.05)) is None
    to_the_end = replace(LONG, faults=FaultsSection(rules=(replace(FAULT, duration=None),)))
    assert found("recovery", to_the_end, still, _displaced(2.0, 25.05)) is None


def test_recovery_counts_from_the_last_change_and_leave_to_resume() -> None:
    late = standing(0, 0), _displaced(0.0, 23.05)
    places, edges = ((1, 0.0, 0.0), (2, 1.0, 0.0)), ((1, 2, 1.0),)
    for t, fires in ((2.0, True), (4.0, False)):
        mission = Mission(2, ns(t), EPOCH_NS, 30 * 10**9, "", ns(t), robots=places, edges=edges)
        change = [(ns(t), key_expressions.mission(NAME), mission)]
        known = both(knows(1, mission_version=2), knows(2, mission_version=2))
        assert bool(found("recovery", LONG, *late, extra=change, change=known)) == fires
        orders = [stop(0.5), resume(t, 2)]
        stands = both(braking(1, 0.5, t), braking(2, 0.5, t))
        assert bool(found("recovery", LONG, *late, extra=orders, change=stands)) == fires
        events = [event(0.5, 2, "agent", "kill"), event(t, 2, "agent", "start")]
        assert bool(found("recovery", LONG, *late, extra=events, change=braking(2, 0.5, t))) == fires
        taken = both(saying(2, "released", 0.4, t), braking(2, 0.4, t))
        assert bool(found("recovery", LONG, *late, change=taken)) == fires


def test_recovery_beside_what_fails_all_the_time() -> None:
    always = replace(LONG, faults=FaultsSection(rules=(FAULT, Rule(robot=2, jump_m=0.01))))
    assert found("recovery", always, standing(0, 0), _displaced(2.0, 25.05))


def test_where_links_fail_all_the_time_a_robot_may_hold_now_and_then() -> None:
    loss = Effect(Loss.parse("30%"))
    lossy = replace(LONG, faults=FaultsSection(rules=(FAULT, Rule(robot=2, loss=loss))))
    for fleet, begin_s, end_s, fires in (
        (lossy, 24.0, 26.0, False),
        (replace(LONG, faults=FaultsSection(loss=loss, rules=(FAULT,))), 24.0, 26.0, False),
        (lossy, 10.0, 40.0, True),  # it never drives again
        (replace(LONG, faults=FaultsSection(rules=(FAULT,))), 24.0, 26.0, True),
    ):
        assert bool(found("recovery", fleet, change=saying(2, "holding", begin_s, end_s))) == fires


def test_a_robot_whose_clock_is_ahead_ends_its_drive_sooner() -> None:
    ahead = replace(LONG, faults=FaultsSection(rules=(FAULT, Rule(robot=2, clock_skew=ClockError(0.5)))))
    for begin_s, fires in ((29.55, False), (29.2, True)):
        change = both(saying(2, "stopping", begin_s, 40.0), shifted)
        recording = recorded(ahead, *_in_place(ahead), change=change)
        assert bool(examined(recording)["recovery"]) == fires


def shifted(t: float, message: Any) -> Any:
    """Robot 2's messages with stamps of a clock half a second ahead."""
    own = getattr(message, "robot", 0) == 2
    return message._replace(time_ns=message.time_ns + 500_000_000) if own else message


def test_recovery_of_robots() -> None:
    assert found("recovery", FAULTY, change=saying(2, "holding", 2.0, 22.0)) == []
    (sentence,) = found("recovery", FAULTY, change=saying(2, "holding", 2.0, 25.1)) or []
    assert sentence.startswith("Robot 2 did not drive at 23.0 s but was holding: the last fault")
    assert found("recovery", FAULTY, change=saying(2, "released", 2.0, 40.0)) == []
    assert found("recovery", FAULTY, change=saying(2, "released", 2.0, 9.0)) == []
    assert found("recovery", FAULTY, change=saying(2, "degraded", 2.0, 25.0)) == []
    lost = [event(2.5, 2, "agent", "kill")]
    assert (
        found(
            "recovery", FAULTY, change=both(saying(2, "fault", 2.0, 40.0), braking(2, 2.6, 40.0)), extra=lost
        )
        == []
    )


def test_beside_a_body_that_nobody_hears_who_does_not_go_on_says_why() -> None:
    kill = Rule(robot=3, kill="agent", at=2.5)
    row = make_fleet([(0, 0), (1, 0), (2, 0)], [(1, 2), (2, 3)], duration_s=30.0, rate_hz=10.0)
    row = replace(row, faults=FaultsSection(rules=(kill,)))
    gone = both(
        braking(3, 2.6, 40.0), lambda t, m: None if type(m) is Status and m.robot == 3 and t > 2.5 else m
    )
    for reason, fires in (("", True), ("its place is taken by robot 3 (silent for 20 s)", False)):
        for state, path in (("holding", standing(1, 0)), ("running", standing(1.2, 0))):
            told = both(gone, saying(2, state, 4.0, 40.0, reason))
            ways = standing(0, 0), path, standing(2, 0)
            options: Any = {"change": told, "extra": [event(2.5, 3, "agent", "kill")]}
            assert bool(found("recovery", row, *ways, **options)) == fires, (reason, state)


def test_recovery_counts_the_way_that_was_left() -> None:
    far = replace(FAULTY, control=replace(FAULTY.control, max_speed_mps=0.1))

    def comes(t: float) -> tuple[float, float, float]:
        return 1.0 + max(0.0, min(1.5, 1.5 - 0.06 * (t - 3.0))) * (t > 2.0), 0.0, 0.0

    assert found("recovery", FAULTY, standing(0, 0), comes)
    assert found("recovery", far, standing(0, 0), comes) == []


def test_recovery_does_not_judge_the_edges_of_who_stands_in_anothers_way() -> None:
    line = make_fleet([(0, 0), (1, 0), (2, 0)], [(1, 2), (2, 3)], duration_s=30.0, rate_hz=10.0)
    line = replace(line, faults=FaultsSection(rules=(FAULT,)))
    off = standing(1.0, 0.5)
    assert found("recovery", line, standing(0.7, 0.5), off, standing(2, 0))  # 1 and 2 share one
    assert found("recovery", line, standing(0, 0), off, standing(2, 0))
    assert found("recovery", line, standing(0, 0), off, standing(0.4, 0)) == []  # 1 and 3 share no edge
    near = ObstacleSection(centre_m=(1.0, 1.5), radius_m=0.5)
    assert found("recovery", replace(line, obstacles=(near,)), standing(0, 0), off, standing(2, 0)) == []


def late(text: str, **more: Any) -> Fleet:
    return replace(LONG, faults=FaultsSection(delay=Effect(Delay.parse(text)), **more))


def test_a_fleet_to_which_nothing_happens_is_formed() -> None:
    off = standing(1.06, 0)
    apart = "Robots 1 and 2 were 1.060 m apart instead of 1.000 m at the end, although nothing had happened"
    assert found("formed", LONG) == []
    for calm in (LONG, late("1s"), late("300ms", loss=Effect(Loss.parse("50%")))):
        (sentence,) = found("formed", calm, standing(0, 0), off) or []
        assert sentence.startswith(apart), sentence
    for harsh in (late("2s"), late("0ms", loss=Effect(Loss.parse("60%")))):
        assert found("formed", harsh, standing(0, 0), off) is None
    cut = replace(LONG, faults=FaultsSection(rules=(Rule(partition=Partition.parse("1 | 2"), at=3.0),)))
    assert found("formed", cut, standing(0, 0), off) is None
    obstacle = ObstacleSection(centre_m=(5.0, 5.0), radius_m=0.5)
    assert found("formed", replace(LONG, obstacles=(obstacle,)), standing(0, 0), off) is None
    assert (
        found("formed", replace(LONG, fleet=replace(LONG.fleet, duration_s=15.0)), standing(0, 0), off)
        is None
    )


def test_a_formation_beside_its_course_is_not_formed() -> None:
    assert found("formed", LONG, standing(0, 0.6), standing(1, 0.6)) == [
        "Robot 1 was 0.60 m from its place at the end, although nothing had happened to the fleet."
    ]
    assert found("formed", LONG, standing(0, 0.24), standing(1, 0.24)) == []


def test_by_when_a_formation_stands_follows_from_speeds() -> None:
    control = ControlSection(max_speed_mps=1.5, max_acceleration=2.0)
    fleet = replace(LONG, control=control)
    assert formed_by_s(0.0, 0.0, fleet) == 20.0
    assert formed_by_s(3.0, 0.0, fleet) == 22.0
    assert formed_by_s(3.0, 1.0, fleet) == pytest.approx(20.0 + 3.25 / 0.5)
    # One that no robot can follow: the lag grows for ever, and is judged all the same.
    assert formed_by_s(0.0, 3.0, fleet) == pytest.approx(20.0 + 0.5625 / 0.15)


def test_errors_where_only_links_fail() -> None:
    wide = make_fleet([(0.0, 0.0), (4.0, 0.0)], [(1, 2)], duration_s=4.0)
    lossy = replace(wide, faults=FaultsSection(loss=Effect(Loss.parse("30%"))))
    off = standing(4.15, 0)  # 4 %: settled
    assert found("errors", lossy, standing(0, 0), standing(4.05, 0)) == []
    assert found("errors", lossy, standing(0, 0), off) == [
        "Robots 1 and 2 were 0.150 m off their distance of 4.000 m at the end, although only links failed: "
        "at most 0.1 m is allowed."
    ]
    assert found("errors", wide, standing(0, 0), off) is None
    gone = [event(1.0, 2, "agent", "kill"), event(1.1, 2, "agent", "start")]
    assert found("errors", lossy, standing(0, 0), off, extra=gone) is None
    assert (
        found("errors", lossy, standing(0, 0), standing(4.5, 0)) is None
    )  # what has not settled says so itself
    noisy = replace(lossy, faults=replace(lossy.faults, rules=(Rule(robot=1, jump_m=0.1),)))
    assert found("errors", noisy, standing(0, 0), off) is None
