"""Whatever robot 2's computer gives as its recording, in every field: what is made of the others' stays.

Three robots drive and are stopped, and drive on all the same, so that there is something to be said of each.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from hypothesis import given, settings
from hypothesis import strategies as st

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.loading import digest, to_dict
from handfast.agent.formation.geometry import resolved
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import decode, encode
from handfast.agent.messages.types import (
    CLASSES,
    TIME_NS_MAX,
    Beacon,
    Decision,
    Faults,
    LinkTrace,
    Message,
    Mission,
    Resume,
    Status,
    Stop,
)
from handfast.agent.recorder.folder import RecordingFolder
from handfast.agent.recorder.recorder import About, Received, RobotRecorder, order_keys
from handfast.agent.security.identity import of_operator
from handfast.agent.security.sealed_order import Opener, Sealer
from handfast.deploy.merging.merge import Choice, Known, Merged, merge
from handfast.deploy.recording.recording import Recording
from handfast.deploy.recording.tables import LinkTable, StatusTable, Table
from tests.declared_messages import messages_of
from tests.trusted import authority, credentials
from tests.unit.deploy.synthetic_run import EPOCH_NS, in_formation, make_fleet, messages, triangle

FLEET = resolved(make_fleet(*triangle(2), name="guarded", duration_s=5.0, rate_hz=10.0))
OTHER = resolved(make_fleet(*triangle(2), name="guarded", duration_s=4.0, rate_hz=10.0))
NAME, IDS, LIAR = FLEET.fleet.name, FLEET.ids, 2
HONEST = tuple(robot for robot in IDS if robot != LIAR)
TOML = tomli_w.dumps(to_dict(FLEET))
MISSION = Mission(1, EPOCH_NS - NS_PER_S // 2, EPOCH_NS, 5 * NS_PER_S, digest(FLEET))
STOP = Stop(3, EPOCH_NS + 4 * NS_PER_S, "that is enough")
ABOUT = About(NAME, digest(FLEET), 0, "0.1.0", TOML)
TIMES = st.integers(EPOCH_NS - 10 * NS_PER_S, EPOCH_NS + 20 * NS_PER_S) | st.integers(0, TIME_NS_MAX)


@dataclass(frozen=True)
class Given:
    """A recording: whose it is, orders from before, messages"""

    about: About
    received: tuple[Received, ...] = ()
    known: tuple[Received, ...] = ()


@dataclass(frozen=True)
class Scene:
    """Honest recordings, and who knows which orders are genuine."""

    orders: tuple[bytes, ...]
    known: Known

    def honest(self, robot: int) -> Given:
        told = [
            (time_ns + NS_PER_S // 100, key_expressions.relayed(NAME, robot), payload)
            for time_ns, payload in zip((MISSION.time_ns, STOP.time_ns), self.orders, strict=True)
        ]
        return Given(ABOUT._replace(robot=robot), tuple(sorted([*told, *said(robot)])))


def said(robot: int) -> Iterator[Received]:
    for received_ns, key, message in messages(FLEET, in_formation(FLEET, 0.3, calm_s=0.4)):
        if not isinstance(message, Mission) and message[0] == robot:
            yield received_ns, key, encode(message)


SAID = tuple(said(LIAR))
ANY = st.one_of(*map(messages_of, CLASSES))
KEYS = st.sampled_from(
    [
        *(key for robot in (*IDS, 9) for key in key_expressions.said_by(NAME, robot)),
        *(key_expressions.relayed(NAME, robot) for robot in (*IDS, 9)),
        *(key(NAME) for key in (key_expressions.mission, key_expressions.stop, key_expressions.resume)),
        *(key(NAME) for key in (key_expressions.faults, key_expressions.events, key_expressions.heartbeat)),
        f"{NAME}/robot/{LIAR}/anything",
        "another/robot/1/hand",
    ]
)


@st.composite
def forged_message(draw: st.DrawFn) -> Received:
    """Any message, or one that it said with any one of its fields as it likes, on any key, at any time."""
    received_ns, key, payload = draw(st.sampled_from(SAID))
    if draw(st.booleans()):
        message: Message = decode(payload)
        other = draw(messages_of(type(message)))
        field = draw(st.sampled_from(message._fields))
        try:
            payload = encode(message._replace(**{field: getattr(other, field)}))
        except Exception:  # fields that do not go together are no message
            payload = b"nonsense"
    else:
        key, payload = draw(KEYS), encode(draw(ANY))
    if draw(st.booleans()):
        received_ns = draw(TIMES)
    return received_ns, key, payload


@st.composite
def credible(draw: st.DrawFn) -> Received:
    """What would mean something to who believes it, where it would be looked for."""
    at_ns = draw(st.integers(EPOCH_NS, EPOCH_NS + 5 * NS_PER_S))
    version, robot = draw(st.integers(0, 9)), draw(st.sampled_from(IDS))
    told = key_expressions.relayed(NAME, LIAR)
    rules = draw(st.sampled_from(['loss = "100 %"', "tick_jitter = 0.9", 'partition = "1 | 3"']))
    faults = Faults(version, at_ns, "ann", at_ns, 0, f"[[faults.rule]]\n{rules}\n")
    late = Decision(robot, draw(st.integers(0, 3)), version, at_ns, 0, draw(st.integers(-1, 9 * 10**6)))
    status = next(decode(payload) for _, key, payload in SAID if key == key_expressions.status(NAME, LIAR))
    assert isinstance(status, Status)
    beacon = draw(messages_of(Beacon))._replace(robot=robot, time_ns=at_ns)
    clock = tuple((other, 1000, 1, 0, draw(st.sampled_from((0, 10**7))), 10) for other in HONEST)
    key, message = draw(
        st.sampled_from(
            [
                (told, Stop(version, at_ns, "made up")),
                (told, Resume(version, at_ns, ())),
                (told, MISSION._replace(version=version, time_ns=at_ns, epoch_ns=at_ns)),
                (told, MISSION._replace(version=version, digest=digest(OTHER))),
                *((key_expressions.faults_held(NAME, LIAR, role), faults) for role in ("agent", "plant")),
                (key_expressions.faults_held(NAME, LIAR, "agent"), faults._replace(rules="")),
                *(
                    (key(NAME, LIAR), LinkTrace(robot, 1, at_ns, (late,)))
                    for key in (key_expressions.links, key_expressions.plant_links)
                ),
                (key_expressions.beacon(NAME, LIAR), beacon),
                (
                    key_expressions.status(NAME, LIAR),
                    status._replace(robot=robot, time_ns=at_ns, order_version=version, neighbours=clock),
                ),
            ]
        )
    )
    return at_ns, key, encode(message)


@st.composite
def forged(draw: st.DrawFn, honest: Given) -> Given:
    """A recording of robot 2 in which anything may be anything else."""
    about = ABOUT._replace(robot=LIAR)
    lie: dict[str, Any] = draw(
        st.just({})
        | st.fixed_dictionaries(
            {},
            optional={
                "fleet": st.sampled_from([NAME, "other"]),
                "digest": st.sampled_from([digest(FLEET), digest(OTHER), "", "x" * 99]),
                "robot": st.sampled_from([*IDS, 0, -1]),
                "version": st.text(max_size=30),
                "fleet_toml": st.sampled_from(
                    [
                        tomli_w.dumps(to_dict(OTHER)), "", "[", "x" * 10_000,
                        TOML.replace(NAME, "\\u001b[2J"),
                        TOML.replace('description = ""', 'description = "mine"'),
                        TOML.replace("mass_kg = 1.0", "mass_kg = 7.0"),
                    ]
                ),
            },
        )
    )  # fmt: skip
    lies = st.lists(forged_message() | credible(), max_size=30)
    received, known = draw(lies), draw(lies)
    if draw(st.booleans()):
        received += honest.received[draw(st.integers(0, 50)) :]
    received.sort(key=lambda one: one[0])
    return Given(about._replace(**lie), tuple(received), tuple(known))


def write(folder: Path, given: Given) -> Path:
    keys = order_keys(NAME, given.about.robot) | order_keys(NAME, LIAR)
    with (
        RecordingFolder(folder, 10**9, 0) as files,
        RobotRecorder(files, given.about, keys, given.known, lambda _: None) as recorder,
    ):
        for each in given.received:
            recorder.add(*each)
        recorder.end_file(EPOCH_NS)
    return folder


def merged(folder: Path, scene: Scene, of_liar: Given) -> Merged:
    folders = {
        robot: write(folder / f"robot-{robot}", of_liar if robot == LIAR else scene.honest(robot))
        for robot in IDS
    }
    return merge(folders, folder / "run", Choice(NAME), known=scene.known, report=False)


def numbers(table: Table | StatusTable | LinkTable) -> list[Any]:
    return [each.tolist() if isinstance(each, np.ndarray) else each for each in vars(table).values()]


def of_others(found: Merged) -> dict[str, Any]:
    """All that a run holds and says of robots 1 and 3, and of the fleet."""
    recording: Recording = found.result.recording
    metrics = found.result.metrics
    links = recording.links
    return {
        "robots": {
            robot: [numbers(each) for name, each in vars(recording.robots[robot]).items() if name in PARTS]
            for robot in HONEST
        },
        "links": numbers(links[links.destination != LIAR]),
        "orders": (recording.missions, recording.stops, recording.resumes, recording.epoch_ns),
        "fleet": recording.fleet,
        "faults": recording.live_faults,
        "events": recording.events,
        "beacons": {robot: recording.beacons[robot] for robot in HONEST},
        "window": (found.since_ns, found.until_ns),
        "reasons": [each for each in metrics["verdict"]["reasons"] if not names_liar(each)],
        "warnings": [each for each in metrics["verdict"]["warnings"] if not names_liar(each)],
        "measured": [each for each in metrics["links"] if str(LIAR) not in re.split("->", each["link"])],
        "clocks": [each for each in metrics["clock_offsets"] if each["robot"] != LIAR],
    }


PARTS = ("plant", "truth", "hand", "multipliers", "wrench", "status")


def names_liar(text: str) -> bool:
    return re.search(rf"\b[Rr]obots? ([0-9]+, )*([0-9]+ and )?{LIAR}\b|\b{LIAR}\b", text) is not None


@pytest.fixture(scope="module", params=["unsecured", "secured"])
def scene(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Scene]:
    if request.param == "unsecured":
        yield Scene((encode(MISSION), encode(STOP)), Known(FLEET))
        return
    folder, now_s = tmp_path_factory.mktemp("keys"), EPOCH_NS / NS_PER_S - 1e5
    with authority(folder / "authority", now_s) as by:
        ann = credentials(by, folder / "ann", of_operator(NAME, "ann"), now_s=now_s)
        sealer = Sealer(ann)
        sealed = tuple(sealer.seal(encode(order), order.time_ns) for order in (MISSION, STOP))
        yield Scene(sealed, Known(FLEET, Opener(NAME, ["ann"], ann.authority)))


@pytest.fixture(scope="module")
def truth(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What is said when nobody lies."""
    found = of_others(merged(tmp_path_factory.mktemp("truth"), scene, scene.honest(LIAR)))
    assert [reason.split(" at ")[0] for reason in found["reasons"]] == [
        "The run ended after 4.0 s of the 5.0 s that were planned: it was stopped.",
        "The plant of robot 1 drove",
        "The plant of robot 3 drove",
    ]
    assert found["orders"] == ((MISSION,), (STOP,), (), EPOCH_NS)
    return found


@pytest.mark.slow
@settings(max_examples=60)
@given(data=st.data())
def test_forged_records_of_one_robot_leave_the_others_as_they_are(
    scene: Scene, truth: dict[str, Any], data: st.DataObject
) -> None:
    lies = data.draw(forged(scene.honest(LIAR)))
    with tempfile.TemporaryDirectory() as folder:
        found = of_others(merged(Path(folder), scene, lies))
    for what, of_all in truth.items():
        assert found[what] == of_all, what
