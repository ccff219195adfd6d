"""One run's folder out of what robots' computers recorded."""

from __future__ import annotations

import json
import time
import tracemalloc
from collections.abc import Callable, Iterable, Iterator, Sequence
from io import BytesIO
from pathlib import Path

import pytest
import tomli_w
from mcap.reader import make_reader

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.loading import digest, to_dict
from handfast.agent.fleet.model import Fleet
from handfast.agent.formation.geometry import resolved
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import encode
from handfast.agent.messages.types import Mission, PlantState, Resume, Status, Stop
from handfast.agent.recorder.folder import RecordingFolder, recording_files
from handfast.agent.recorder.recorder import About, Received, RobotRecorder, order_keys
from handfast.deploy.merging.merge import MARGIN_NS, Choice, Merged, merge
from handfast.deploy.merging.robot_files import Damage, MergeError, RobotFile, by_time, recordings
from handfast.deploy.recording.mcap_reader import read_mcap, read_run
from handfast.deploy.report.run_folder import FolderError, RunFolder, rebuild
from tests.unit.deploy.synthetic_run import EPOCH_NS, in_formation, make_fleet, messages, triangle

FLEET = resolved(make_fleet(*triangle(2), duration_s=2.0))
NAME = FLEET.fleet.name
IDS = FLEET.ids
MISSION = Mission(1, EPOCH_NS - NS_PER_S // 2, EPOCH_NS, 2 * NS_PER_S, digest(FLEET))


def toml(fleet: Fleet) -> str:
    return tomli_w.dumps(to_dict(fleet))


def said(robot: int, fleet: Fleet = FLEET, order_version: int = 0) -> Iterator[Received]:
    """What a robot's agent and plant say during a drive, the mission as it tells it on."""
    for received_ns, key, message in messages(fleet, in_formation(fleet, 0.3, calm_s=0.4)):
        if isinstance(message, Mission):
            yield received_ns, key_expressions.relayed(NAME, robot), encode(MISSION)
        elif isinstance(message, Status) and message.robot == robot:
            yield received_ns, key, encode(message._replace(order_version=order_version))
        elif message[0] == robot:
            yield received_ns, key, encode(message)


def spoken(robot: int) -> int:
    """How many messages that are, but for the mission."""
    return len(list(said(robot))) - 1


ALL = sum(map(spoken, IDS)) + 1
"""Messages of a merged run: each order is there once."""


def shifted(sent: Iterable[Received], by_s: float) -> Iterator[Received]:
    for received_ns, key, payload in sent:
        yield received_ns + round(by_s * NS_PER_S), key, payload


class Computer:
    """A robot's computer, whose recorder can be ended at any time, and started again."""

    def __init__(self, folder: Path, robot: int, fleet: Fleet = FLEET) -> None:
        self.folder, self.robot = folder / f"robot-{robot}", robot
        text = toml(fleet)
        self.about = About(fleet.fleet.name, digest(fleet), robot, "0.2.0", text)

    def record(self, sent: Iterable[Received], *, files: int = 1, known: Iterable[Received] = ()) -> None:
        sent = list(sent)
        orders = order_keys(self.about.fleet, self.robot)
        with (
            RecordingFolder(self.folder, 1_000_000_000, 0) as folder,
            RobotRecorder(folder, self.about, orders, known, lambda _: None) as recorder,
        ):
            for number, each in enumerate(sent):
                if number and number % (len(sent) // files + 1) == 0:
                    recorder.end_file(each[0])
                while not recorder.is_idle:
                    time.sleep(0)
                recorder.flush_if_due(each[0])
                recorder.add(*each)
            recorder.end_file(sent[-1][0])


def record_all(
    folder: Path, change: Callable[[int, list[Received]], list[Received]] | None = None
) -> list[Path]:
    """Every robot's computer records a drive; `change` what it hears."""
    for robot in IDS:
        heard = list(said(robot))
        Computer(folder, robot).record(heard if change is None else change(robot, heard), files=2)
    return sorted(folder.iterdir())


def merged(folders: list[Path], out: Path, choice: Choice | None = None) -> Merged:
    """Without pictures, which take a second."""
    return merge(by_robot(folders), out, choice or Choice(NAME), report=False)


def by_robot(folders: Iterable[Path]) -> dict[int, Path]:
    return {int(folder.name.removeprefix("robot-")): folder for folder in folders}


def files_in(folders: Iterable[Path]) -> Sequence[RobotFile]:
    return recordings(by_robot(folders), Damage())


@pytest.mark.slow
def test_the_merged_run_is_the_run(tmp_path: Path) -> None:
    found = merge(by_robot(record_all(tmp_path / "hosts")), tmp_path / "run", Choice(NAME))
    assert found.warnings == ()
    assert found.robots == IDS
    assert found.result.metrics["verdict"] == {"passed": True, "reasons": [], "warnings": []}
    assert (tmp_path / "run" / "report.html").is_file()
    assert (tmp_path / "run" / "fleet.toml").read_text() == toml(resolved(FLEET))
    recording = read_run(tmp_path / "run")
    assert recording.epoch_ns == EPOCH_NS
    assert recording.missions == (MISSION,)
    for robot, data in recording.robots.items():
        sent = [m for _, _, m in messages(FLEET, in_formation(FLEET, 0.3, calm_s=0.4))]
        assert len(data.plant) == sum(isinstance(m, PlantState) and m.robot == robot for m in sent)
    assert found.messages == ALL
    assert rebuild(tmp_path / "run").metrics == found.result.metrics


def test_messages_are_in_order_of_their_reception(tmp_path: Path) -> None:
    files = files_in(record_all(tmp_path / "hosts"))
    times = [received[0] for received in by_time(files, 0, 2**62, Damage())]
    assert times == sorted(times)
    assert len(times) == ALL - 1


def test_a_file_from_before_a_clock_was_set_back_finds_its_place(tmp_path: Path) -> None:
    computer = Computer(tmp_path, 1)
    computer.record(shifted(said(1), 100.0))
    computer.record(said(1))
    times = [received[0] for received in by_time(files_in([computer.folder]), 0, 2**62, Damage())]
    assert times == sorted(times)
    assert len(times) == 2 * spoken(1)


def test_the_last_mission_is_taken(tmp_path: Path) -> None:
    """An earlier drive of the same fleet is left out, and what robots said long before and after."""
    earlier = MISSION._replace(
        version=0, time_ns=MISSION.time_ns - 100 * NS_PER_S, epoch_ns=EPOCH_NS - 100 * NS_PER_S
    )

    def both(robot: int, heard: list[Received]) -> list[Received]:
        old = [(ns, key, encode(earlier) if "told" in key else payload) for ns, key, payload in heard]
        return [*shifted(old, -100.0), *heard, *shifted(heard[1:], 50.0)]

    folders = record_all(tmp_path / "hosts", both)
    found = merged(folders, tmp_path / "last")
    assert (found.since_ns, found.until_ns) == (EPOCH_NS - MARGIN_NS, EPOCH_NS + 2 * NS_PER_S + MARGIN_NS)
    assert found.messages == ALL
    assert found.warnings == ()
    everything = merged(folders, tmp_path / "all", Choice(NAME, everything=True))
    assert everything.messages == 3 * ALL - 1, "twice a mission"
    since = merged(folders, tmp_path / "since", Choice(NAME, until_ns=EPOCH_NS - 50 * NS_PER_S))
    assert read_run(since.folder).epoch_ns == earlier.epoch_ns


@pytest.mark.parametrize(
    ("resumed", "stops", "reasons"), [(IDS, [], 0), ((), [], 0), (IDS[:2], [7], 1), (None, [7], 1)]
)
def test_orders_from_before_that_still_hold(
    tmp_path: Path, resumed: tuple[int, ...] | None, stops: list[int], reasons: int
) -> None:
    """The mission was told ten minutes ahead, in a file that is gone, after a stop and perhaps its end."""
    told_ns = EPOCH_NS - 700 * NS_PER_S
    orders: list[Mission | Stop | Resume] = [
        Stop(5, told_ns, "before the last"),
        Resume(6, told_ns, ()),
        Stop(7, told_ns, "lunch"),
    ]
    orders += [] if resumed is None else [Resume(8, told_ns, resumed)]
    orders += [MISSION._replace(time_ns=told_ns)]
    known = [
        (told_ns + number, key_expressions.relayed(NAME, 1), encode(order))
        for number, order in enumerate(orders)
    ]
    knows = orders[-2].version
    for robot in IDS:
        own = [(ns, key_expressions.relayed(NAME, robot), payload) for ns, _, payload in known]
        Computer(tmp_path / "hosts", robot).record(list(said(robot, FLEET, knows))[1:], known=own)
    found = merged(sorted((tmp_path / "hosts").iterdir()), tmp_path / "run")
    recording = read_run(tmp_path / "run")
    assert recording.epoch_ns == EPOCH_NS
    assert [stop.version for stop in recording.stops] == stops
    assert [resume.version for resume in recording.resumes] == ([8] if stops and resumed else [])
    assert len(found.result.metrics["verdict"]["reasons"]) >= reasons
    assert found.result.metrics["verdict"]["passed"] is not bool(reasons)


def test_a_mission_of_another_fleet_file_is_not_the_last(tmp_path: Path) -> None:
    stray = MISSION._replace(version=9, epoch_ns=EPOCH_NS + 900 * NS_PER_S, digest="fedcba9876543210")

    def with_stray(robot: int, heard: list[Received]) -> list[Received]:
        return [*heard, (heard[-1][0], key_expressions.relayed(NAME, robot), encode(stray))]

    found = merged(record_all(tmp_path / "hosts", with_stray), tmp_path / "run")
    assert found.since_ns == EPOCH_NS - MARGIN_NS


# --- what is missing ------------------------------------------------------------------------------


def test_a_robot_that_is_missing_is_named(tmp_path: Path) -> None:
    folders = record_all(tmp_path / "hosts")
    found = merged(folders[:2], tmp_path / "run")
    assert found.warnings == ("nothing that robot 3 recorded is here",)
    assert found.result.metrics["verdict"]["warnings"][0] == "nothing that robot 3 recorded is here."
    assert json.loads((tmp_path / "run" / "metrics.json").read_text()) == found.result.metrics
    assert rebuild(tmp_path / "run").metrics == found.result.metrics, "the recording itself says so"


def test_gaps_are_named(tmp_path: Path) -> None:
    def gap(robot: int, heard: list[Received]) -> list[Received]:
        begin, end = EPOCH_NS + 200_000_000, EPOCH_NS + 1_400_000_000
        return [each for each in heard if robot != 2 or not begin < each[0] < end]

    found = merged(record_all(tmp_path / "hosts", gap), tmp_path / "run")
    assert found.warnings == ("nothing was recorded of robot 2 from 0.2 s to 1.4 s",)


def test_a_recording_that_ends_early_is_named(tmp_path: Path) -> None:
    def cut(robot: int, heard: list[Received]) -> list[Received]:
        return [each for each in heard if robot != 2 or each[0] < EPOCH_NS + NS_PER_S]

    found = merged(record_all(tmp_path / "hosts", cut), tmp_path / "run")
    (warning,) = found.warnings
    assert warning == "nothing was recorded of robot 2 from 1.0 s to 2.2 s"


def test_a_start_again_is_no_gap(tmp_path: Path) -> None:
    for robot in IDS:
        heard = list(said(robot))
        computer = Computer(tmp_path / "hosts", robot)
        computer.record(heard[:300])
        computer.record(heard[320:])
    found = merged(sorted((tmp_path / "hosts").iterdir()), tmp_path / "run")
    assert found.warnings == ()


def damaged(path: Path, chunk: int) -> None:
    """Change a byte in the content of one of a file's chunks."""
    data = bytearray(path.read_bytes())
    summary = make_reader(BytesIO(data)).get_summary()
    assert summary is not None
    index = summary.chunk_indexes[chunk]
    data[index.chunk_start_offset + index.chunk_length - 20] ^= 1
    path.write_bytes(data)


def test_damage_is_counted_and_the_rest_is_there(tmp_path: Path) -> None:
    folders = record_all(tmp_path / "hosts")
    damaged(recording_files(folders[1])[0], -1)
    found = merged(folders, tmp_path / "run")
    assert "of robot 2's recording a damaged piece is left out" in found.warnings
    assert ALL - 200 < found.messages < ALL


@pytest.mark.parametrize("at", [1, 20, 60, 200])
def test_a_file_whose_beginning_is_damaged_is_its_neighbours(tmp_path: Path, at: int) -> None:
    folders = record_all(tmp_path / "hosts")
    for path in (recording_files(folders[0])[0], recording_files(folders[1])[1]):
        data = bytearray(path.read_bytes())
        data[at] ^= 1
        path.write_bytes(data)
    found = merged(folders, tmp_path / "run")
    assert found.messages == ALL
    assert found.result.metrics["verdict"]["reasons"] == []


def test_a_power_loss_costs_the_last_second(tmp_path: Path) -> None:
    """The file then has no index, and ends within a chunk."""
    folders = record_all(tmp_path / "hosts")
    path = recording_files(folders[1])[-1]
    summary = make_reader(BytesIO(path.read_bytes())).get_summary()
    assert summary is not None
    path.write_bytes(path.read_bytes()[: summary.chunk_indexes[-1].chunk_start_offset + 50])
    found = merged(folders, tmp_path / "run")
    assert ALL - 200 < found.messages < ALL
    assert not any("damaged" in warning for warning in found.warnings)


def test_any_tool_reads_a_robots_file(tmp_path: Path) -> None:
    """Each key is a channel of JSON with a schema; orders are there as well."""
    (path,) = recording_files(record_one(tmp_path))
    read = [
        (channel.topic, schema.name if schema else "", json.loads(message.data))
        for schema, channel, message in make_reader(
            BytesIO(path.read_bytes()), validate_crcs=True
        ).iter_messages()
    ]
    assert len(read) == len(list(said(1)))
    assert {name for _, name, _ in read} >= {"handfast.HandState", "handfast.Status", "handfast.Mission"}
    assert read_mcap(path).fleet == resolved(FLEET)


def record_one(folder: Path) -> Path:
    Computer(folder, 1).record(said(1))
    return folder / "robot-1"


# --- what is taken --------------------------------------------------------------------------------


def test_another_fleet_file_is_left_out_and_named(tmp_path: Path) -> None:
    other = resolved(make_fleet(*triangle(2), duration_s=99.0))
    for robot in IDS:
        fleet = other if robot == 2 else FLEET
        Computer(tmp_path / "hosts", robot, fleet).record(said(robot))
    found = merged(sorted((tmp_path / "hosts").iterdir()), tmp_path / "run")
    assert found.robots == (1, 3)
    assert found.warnings[0] == "what robot 2 recorded is left out: it ran another fleet file in this time"


def test_without_a_mission_the_file_of_most_counts(tmp_path: Path) -> None:
    other = resolved(make_fleet(*triangle(2), duration_s=99.0))
    for robot in IDS:
        fleet = other if robot == 3 else FLEET
        Computer(tmp_path / "hosts", robot, fleet).record(list(said(robot))[1:])
    found = merged(sorted((tmp_path / "hosts").iterdir()), tmp_path / "run")
    assert found.robots == (1, 2)
    assert found.warnings[0] == "no mission was recorded: this is all that there is"


def test_one_fleet_of_several(tmp_path: Path) -> None:
    folders = record_all(tmp_path / "hosts")
    later = resolved(make_fleet(*triangle(2), name="later"))
    of_later = [(ns, key.replace(f"{NAME}/", "later/", 1), payload) for ns, key, payload in said(1)]
    Computer(tmp_path / "later", 1, later).record(shifted(of_later, 1000.0))
    for path in (tmp_path / "later" / "robot-1").glob("*.mcap"):
        path.rename(folders[0] / path.name)
    assert merged(folders, tmp_path / "named", Choice(fleet=NAME)).robots == IDS
    with pytest.raises(MergeError, match="no recordings of a fleet none in what was given"):
        merged(folders, tmp_path / "none", Choice(fleet="none"))
    assert merged(folders, tmp_path / "later-run", Choice(fleet="later")).robots == (1,)


def test_nothing_there_is_one_clear_line(tmp_path: Path) -> None:
    (tmp_path / "robot-1").mkdir()
    with pytest.raises(MergeError, match="no recordings of a fleet made-up in what was given"):
        merged([tmp_path / "robot-1"], tmp_path / "run")
    with pytest.raises(MergeError, match=r"cannot read .*robot-2: No such file"):
        merged([tmp_path / "robot-2"], tmp_path / "run")
    folders = record_all(tmp_path / "hosts")
    with pytest.raises(MergeError, match=r"nothing was recorded from 1970-.* until 1970-.*, only from 2025-"):
        merged(folders, tmp_path / "run", Choice(NAME, since_ns=1, until_ns=NS_PER_S))
    with pytest.raises(MergeError, match="the end is before the beginning"):
        merged(folders, tmp_path / "run", Choice(NAME, since_ns=EPOCH_NS, until_ns=EPOCH_NS))
    assert not (tmp_path / "run").exists()
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "something").touch()
    with pytest.raises(FolderError, match="is not empty"):
        merged(folders, tmp_path / "run")


def test_a_fleet_file_of_another_version(tmp_path: Path) -> None:
    computer = Computer(tmp_path, 1)
    computer.about = computer.about._replace(fleet_toml="[fleet]\nname = 'made-up'\nwarp = 9\n")
    computer.record(said(1))
    with pytest.raises(MergeError, match="no recording can be used: what robot 1 recorded: the fleet file"):
        merged([computer.folder], tmp_path / "run")


# --- what is believed ------------------------------------------------------------------------------


def test_a_computer_cannot_speak_for_another_robot(tmp_path: Path) -> None:
    """Robot 2's computer gives recordings that say they are robot 1's, and messages of robot 1 in its own."""
    made_up = [each for each in said(1) if "told" not in each[1]]

    def with_made_up(robot: int, heard: list[Received]) -> list[Received]:
        return sorted([*heard, *made_up]) if robot == 2 else heard

    folders = record_all(tmp_path / "hosts", with_made_up)
    Computer(tmp_path / "posing", 1).record(said(1))
    for path in (tmp_path / "posing" / "robot-1").glob("*.mcap"):
        path.rename(folders[1] / path.name)
    found = merged(folders, tmp_path / "run")
    assert found.messages == ALL
    assert found.warnings == (
        "robot 2's computer also gave recordings of other robots: they are left out",
        f"of robot 2's recording {len(made_up)} messages are left out that it alone tells of, or cannot",
    )


def test_orders_are_believed_from_keys_of_orders_only(tmp_path: Path) -> None:
    later = MISSION._replace(version=9, epoch_ns=EPOCH_NS + 900 * NS_PER_S)

    def with_stray(robot: int, heard: list[Received]) -> list[Received]:
        stray = (heard[0][0], key_expressions.relayed(NAME, 1), encode(later))
        return [heard[0], stray, *heard[1:]] if robot == 2 else heard

    folders = record_all(tmp_path / "hosts", with_stray)
    path = recording_files(folders[1])[0]  # nor where the metadata that say whose it is are damaged
    data = bytearray(path.read_bytes())
    data[60] ^= 1
    path.write_bytes(data)
    assert merged(folders, tmp_path / "run").since_ns == EPOCH_NS - MARGIN_NS


def test_one_recording_does_not_say_how_long_the_others_should_be(tmp_path: Path) -> None:
    def longer(robot: int, heard: list[Received]) -> list[Received]:
        return [*heard, *shifted(heard[-5:], 60.0)] if robot == 2 else heard

    assert (
        merged(
            record_all(tmp_path / "hosts", longer), tmp_path / "run", Choice(NAME, everything=True)
        ).warnings
        == ()
    )


# --- what it leaves --------------------------------------------------------------------------------


def test_a_time_between_two_stretches_is_no_damage(tmp_path: Path) -> None:
    def gap(robot: int, heard: list[Received]) -> list[Received]:
        return [each for each in heard if not EPOCH_NS < each[0] < EPOCH_NS + 1_900_000_000]

    folders = record_all(tmp_path / "hosts", gap)
    choice = Choice(NAME, since_ns=EPOCH_NS + 600_000_000, until_ns=EPOCH_NS + 700_000_000)
    with pytest.raises(MergeError, match=r"^nothing was recorded from .* until .*, only from 2025-"):
        merged(folders, tmp_path / "run", choice)
    assert not (tmp_path / "run").exists()
    between = next(said(1))[0] + 1  # within a chunk
    with pytest.raises(MergeError, match=r"^nothing was recorded from "):
        merged(folders[:1], tmp_path / "run", Choice(NAME, since_ns=between, until_ns=between + 1))
    assert not (tmp_path / "run").exists()


def test_what_is_interrupted_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(RunFolder, "finish", interrupted)
    with pytest.raises(KeyboardInterrupt):
        merged(record_all(tmp_path / "hosts"), tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_memory_does_not_grow_with_the_recordings(tmp_path: Path) -> None:
    """Four times as much on the disk takes no more memory to put in order."""

    def peak(times: int) -> int:
        hosts = tmp_path / str(times)
        for robot in IDS:
            heard = list(said(robot))
            for number in range(times):
                Computer(hosts, robot).record(shifted(heard, 3.0 * number))
        files = files_in(sorted(hosts.iterdir()))
        tracemalloc.start()
        count = sum(1 for _ in by_time(files, 0, 2**62, Damage()))
        _, most = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert count == times * (ALL - 1)
        return most

    assert peak(32) < 1.2 * peak(8)
