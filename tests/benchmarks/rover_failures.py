"""Each way in which a rover fails in mid-drive: how soon it is braked, where it stands, what is said of it.

Three rovers drive in formation at 0.5 m/s, in virtual time: agents, bridges at 20 Hz, simulated vehicles with
the measured lags. The second one fails, at another moment of tick and heartbeat, and with another seed, in
every round. Then what failed is mended, and once more it is not, for the verdict. Times are from the failure
in truth; places are the true ones.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from math import hypot, inf, nan
from typing import Any, Final, NamedTuple

from agent.common.time import NS_PER_S
from agent.messages.types import PlantState, Status
from agent.supervision.state_machine import at_rest
from agent.supervision.stop_latch import AWAITED
from bridges.mavlink.ardupilot import constants
from bridges.mavlink.ardupilot.frames import local_to_geodetic
from bridges.mavlink.simulator.in_memory import LATENCY_NS, STEP_NS
from bridges.mavlink.simulator.navigation import Variances
from deploy.verdict.run_result import RunResult
from plant.backend import Command
from tests.benchmarks.figures import Figure, Options, Result, table
from tests.benchmarks.processes import BenchmarkError
from tests.benchmarks.rows import results
from tests.rover_fleet import ROBOT, Drive, Hold, Watch
from tests.rover_scene import MASS, Bridge, Scene

ROUNDS: Final = 4
ROUNDS_QUICK: Final = 2
FAILS_S: Final = 10.0
PHASE_S: Final = (0.003, 0.0617)
"""After a tick, and from round to round so much later: neither a tick nor the period of a heartbeat."""
ITSELF_S: Final = 20.0
"""So long after it is mended a robot may take to drive on by itself."""
WAITS_S: Final = 3.0
"""So long it is watched for whether it drives before it is told to."""
AFTER_S: Final = 20.0
AFTER_SHARE: Final = 2.0
"""A drive goes on so long after a robot has caught up, and so much longer for what it has to catch up."""
MOVES: Final = 0.1
"""m/s at which a rover drives on."""
STEADY_S: Final = 0.5
SAFE_M: Final = 1.0

# What the pages promise, s; of a wrench that is missed: wrench_timeout_s and a tick.
LETS_GO_S: Final = 0.05
SWITCH_S: Final = 0.25
WRENCH_S: Final = 0.30
STOP_S: Final = 0.1
SILENCE_S: Final = 3.1
SILENCE_M: Final = 2.0
FIX_S: Final = 3.0
EKF_S: Final = 0.75
FOLLOWS_S: Final = 3.2


@dataclass(frozen=True)
class Failure:
    """One row.

    Attributes:
        fail, mend: what is done to the drive; `mend` is None where only time or the operator mends it.
        mended_s: how long after the failure.
        when: the failure is not at a time, but as soon as this is true.
        passes: it is over by itself in that time.
        lost_s: how long the drive goes on where it is never mended; 0: that is not tried.
        limit_s: what is promised from the failure to being let go or braked; None: nothing.
        rolls_m: what is promised of how far it rolls.
        parameters: of the vehicle.
    """

    name: str
    fail: Callable[[Drive], object]
    mend: Callable[[Drive], object] | None = None
    mended_s: float = 6.0
    when: Callable[[Drive], bool] | None = None
    passes: bool = False
    lost_s: float = 20.0
    limit_s: float | None = None
    rolls_m: float | None = None
    parameters: dict[str, float] = field(default_factory=dict)


class Found(NamedTuple):
    """What one drive showed. Times are s from the failure; nan where it did not come to that.

    Attributes:
        row, round, mended: which drive it was.
        told: until its agent says so; `words`: state and reason that it then says, in turn.
        neighbour: what robot 1 says of it.
        how: "let go", "braked" or "itself" (the vehicle's own stop), and `asks_no_more`: when.
        obeyed: from the vehicle's own word that it is taken to the bridge's letting go.
        hold: when the vehicle itself went into another mode.
        stood, rolled: when it stood, and m from where it failed.
        asked: setpoints that ask for motion after that, while it is not mended.
        itself, resumed: from the mending, from the resume, to driving on.
        early: whether it drove on between being handed back and the resume.
        closest: of two hand points, m.
        passed, sentences: the verdict, and what it says of robot 2.
    """

    row: int
    round: int
    mended: bool
    speed: float = nan
    told: float = nan
    words: tuple[str, ...] = ()
    neighbour: str = ""
    how: str = ""
    asks_no_more: float = nan
    obeyed: float = nan
    hold: float = nan
    stood: float = nan
    rolled: float = nan
    asked: int = 0
    itself: float = nan
    resumed: float = nan
    early: bool = False
    closest: float = inf
    passed: bool = False
    sentences: tuple[str, ...] = ()
    trouble: str = ""


# ---------------------------------------------------------------------- what is done to it


def mode(name: str) -> Callable[[Drive], object]:
    return lambda drive: drive.rover.set_mode(name)


def parameter(name: str, value: float) -> Callable[[Drive], object]:
    return lambda drive: drive.rover.set_parameter(name, value)


def process(role: str, what: Any) -> Callable[[Drive], object]:
    return lambda drive: drive.process(role, what)


def cut(*, is_cut: bool) -> Callable[[Drive], object]:
    def do(drive: Drive) -> None:
        drive.body().transport.cut = is_cut

    return do


def order(kind: str) -> Callable[[Drive], object]:
    return lambda drive: drive.order(kind)


def silence(drive: Drive) -> None:
    drive.ground_station = False


def without_position(drive: Drive) -> None:
    """Its GPS is as good as ever, but its EKF says that it has no position."""
    navigation = drive.rover._vehicle.navigation
    lost = property(lambda _: constants.EKF_ATTITUDE | constants.EKF_CONST_POS_MODE)
    navigation.__class__ = type("Lost", (type(navigation),), {"flags": lost})


def with_position(drive: Drive) -> None:
    navigation: Any = drive.rover._vehicle.navigation
    navigation.__class__ = type(navigation).__mro__[1]


def variances(velocity: float) -> Callable[[Drive], object]:
    def do(drive: Drive) -> None:
        drive.rover._vehicle.navigation.variances = Variances(velocity=velocity)

    return do


def stuck(drive: Drive) -> None:
    drive.held = Hold(drive.rover)  # type: ignore[attr-defined]


def free(drive: Drive) -> None:
    drive.held.free()  # type: ignore[attr-defined]


def jump(metres: float) -> Callable[[Drive], object]:
    """Its EKF is at another place from one moment to the next, and stays there."""

    def do(drive: Drive) -> None:
        navigation = drive.rover._vehicle.navigation
        navigation._home = local_to_geodetic(navigation._home, metres, 0.0)

    return do


def no_number(drive: Drive) -> None:
    plant: Any = drive.body().plant
    step = drive.step = plant.step  # type: ignore[attr-defined]
    plant.step = lambda now_ns, _: step(now_ns, Command(nan, 0.0))


def number_again(drive: Drive) -> None:
    plant: Any = drive.body().plant
    plant.step = drive.step  # type: ignore[attr-defined]


def nothing(drive: Drive) -> None:
    pass


FENCE: Final = {"FENCE_ENABLE": 1.0, "FENCE_RADIUS": 12.0, "FENCE_ACTION": 2.0}
BATTERY: Final = {"BATT_LOW_VOLT": 10.5, "BATT_FS_LOW_ACT": 2.0}

ROWS: Final = (
    *(
        Failure(f"operator: {name}", mode(name), limit_s=SWITCH_S)
        for name in ("MANUAL", "HOLD", "RTL", "LOITER")
    ),
    Failure("operator: disarms it", lambda drive: drive.rover.disarm(), limit_s=SWITCH_S),
    Failure("handfast stop", order("stop"), mended_s=4.0, limit_s=STOP_S),
    Failure("agent killed", process("agent", "kill"), process("agent", "start"), limit_s=WRENCH_S),
    Failure("agent frozen", process("agent", "stop"), process("agent", "continue"), limit_s=WRENCH_S),
    Failure(
        "bridge killed",
        process("plant", "kill"),
        process("plant", "start"),
        limit_s=SILENCE_S,
        rolls_m=SILENCE_M,
    ),
    Failure("bridge frozen for 1 s", process("plant", "stop"), process("plant", "continue"), 1.0, lost_s=0.0),
    Failure(
        "bridge frozen for 6 s",
        process("plant", "stop"),
        process("plant", "continue"),
        limit_s=SILENCE_S,
        rolls_m=SILENCE_M,
    ),
    Failure("link cut for 2 s", cut(is_cut=True), cut(is_cut=False), 2.0, lost_s=0.0),
    Failure("link cut for 6 s", cut(is_cut=True), cut(is_cut=False), limit_s=SILENCE_S, rolls_m=SILENCE_M),
    Failure("vehicle reboots", lambda drive: drive.rover.reboot(), mended_s=45.0),
    Failure(
        "GPS jammed", parameter("SIM_GPS1_JAM", 1.0), parameter("SIM_GPS1_JAM", 0.0), 15.0, limit_s=FIX_S
    ),
    Failure(
        "GPS off", parameter("SIM_GPS1_ENABLE", 0.0), parameter("SIM_GPS1_ENABLE", 1.0), 15.0, limit_s=FIX_S
    ),
    Failure("EKF without position", without_position, with_position, limit_s=EKF_S),
    Failure("EKF: velocity variance 0.85", variances(0.85), variances(0.02), limit_s=EKF_S),
    Failure("its position jumps 2 m", jump(2.0), passes=True, lost_s=0.0),
    Failure("its position jumps 30 m", jump(30.0), jump(-30.0)),
    Failure("stuck, motors off", stuck, free, 8.0, limit_s=FOLLOWS_S),
    Failure(
        "battery low (its failsafe)",
        parameter("SIM_BATT_VOLTAGE", 9.9),
        parameter("SIM_BATT_VOLTAGE", 12.6),
        15.0,
        parameters=BATTERY,
    ),
    Failure(
        "ground station lost (FS_GCS_ENABLE 1)",
        silence,
        mended_s=10.0,
        parameters={"FS_GCS_ENABLE": 1.0},
    ),
    Failure(
        "before its fence, AVOID_ENABLE 3",
        nothing,
        parameter("FENCE_RADIUS", 300.0),
        12.0,
        when=lambda drive: drive.rover._vehicle.fence.limits(drive.now_ns),
        parameters=FENCE,
    ),
    Failure(
        "at its fence, AVOID_ENABLE 0",
        nothing,
        parameter("FENCE_RADIUS", 300.0),
        when=lambda drive: drive.rover._vehicle.fence.breached,
        parameters=FENCE | {"AVOID_ENABLE": 0.0},
    ),
    Failure("force not a number", no_number, number_again, 3.0, limit_s=STOP_S),
)


# ---------------------------------------------------------------------- one drive


class Failures:
    """All drives, by their number; a `deploy.simulate.worker_pool.Work`."""

    def __init__(self, rounds: int) -> None:
        self.plan = [
            (row, k, mended)
            for row, failure in enumerate(ROWS)
            for mended in (True, False)
            for k in range(rounds if mended else 1)
            if mended or failure.lost_s
        ]

    def execute(self, run: int, go_on: Callable[[], bool]) -> Found:
        """See `Work`."""
        return drive(*self.plan[run])

    def unfinished(self, run: int, reason: str, wall_s: float, *, timed_out: bool) -> Found:
        """See `Work`."""
        return Found(*self.plan[run], trouble=reason)


def drive(row: int, k: int, mended: bool) -> Found:
    """One drive of a row."""
    failure = ROWS[row]
    after_s = ITSELF_S + WAITS_S + AFTER_S + AFTER_SHARE * failure.mended_s
    lasts_s = failure.mended_s + after_s if mended else failure.lost_s
    # The fence is come to later.
    begins_s = FAILS_S + (20.0 if failure.when else 1.0)
    drive = Drive(
        begins_s + lasts_s,
        "trajectory.velocity_mps=[0.5,0.0]",
        f"fleet.seed={k}",
        parameters=failure.parameters,
    )
    drive.ground_station = "FS_GCS_ENABLE" in failure.parameters
    drive.until(FAILS_S - 1.0)
    drive.run(1.0 + PHASE_S[0] + k * PHASE_S[1])
    while failure.when is not None and not failure.when(drive):
        drive.run(STEP_NS / NS_PER_S)
    watch = drive.look()
    failed_ns, heard = drive.now_ns, len(drive.said)
    found = Found(row, k, mended, speed=drive.rover.speed)
    failure.fail(drive)
    if not mended:
        drive.run(min(failure.lost_s, 8.0))
        return judged(drive, found)
    drive.run(failure.mended_s)
    found = seen(watch, drive.said[heard:], found, failed_ns)
    if not failure.passes:
        found = recovered(drive, found._replace(itself=nan), failure)
    return judged(drive, found) if k == 0 else found._replace(closest=drive.closest)


def seconds(since_ns: float, at_ns: float) -> float:
    return (at_ns - since_ns) / NS_PER_S


def seen(watch: Watch, said: Sequence[tuple[int, Any]], found: Found, failed_ns: int) -> Found:
    """What was to be seen until it is mended."""
    states = [(at, m) for at, m in said if isinstance(m, PlantState) and m.robot == ROBOT]
    taken_ns = next((at for at, how in watch.modes if how != (constants.MODE_GUIDED, True)), inf)
    way = {
        "let go": next((at for at, m in states if m.healthy and not m.obeying), inf),
        "braked": next((at for at, speed, rate in watch.asked if speed == rate == 0.0), inf),
        "itself": next((at for at, text in watch.texts if text == constants.SETPOINT_TIMEOUT_TEXT), inf),
    }
    how = min(way, key=way.__getitem__)
    ends_ns = way[how]
    again = [at for at, speed, rate in watch.asked if at > ends_ns and (speed or rate)]
    begun = place = watch.moved[0][1:3]
    stood_ns = inf
    for at, north, east, speed, yaw_rate in reversed(watch.moved):
        if again and at >= again[0]:
            continue
        if not at_rest(speed, yaw_rate):
            break
        stood_ns, place = at, (north, east)
    words = told(said, ROBOT)
    let_go_ns = way["let go"]
    return found._replace(
        told=seconds(failed_ns, words[0][0]) if words else nan,
        words=tuple(text for _, text in words),
        neighbour=next((text for _, text in told(said, 1)), ""),
        how=how if ends_ns < inf else "",
        asks_no_more=seconds(failed_ns, ends_ns) if ends_ns < inf else nan,
        obeyed=seconds(taken_ns + LATENCY_NS, let_go_ns) if taken_ns < let_go_ns < inf else nan,
        hold=seconds(failed_ns, taken_ns) if taken_ns < inf else nan,
        stood=seconds(failed_ns, stood_ns) if stood_ns < inf else nan,
        rolled=hypot(place[0] - begun[0], place[1] - begun[1]) if stood_ns < inf else nan,
        asked=len(again),
        itself=seconds(failed_ns, again[0]) if again else nan,
    )


def told(said: Sequence[tuple[int, Any]], robot: int) -> list[tuple[int, str]]:
    """(ns, state and reason) of what a robot said but that it runs, each reason once."""
    found: list[tuple[int, str]] = []
    known = set()
    for at, message in said:
        if isinstance(message, Status) and message.robot == robot and message.state != "running":
            text = f"{message.state}: {message.reason}" if message.reason else message.state
            kind = "".join(letter for letter in text if not letter.isdigit())
            if kind not in known:
                known.add(kind)
                found.append((at, text))
    return found


def recovered(drive: Drive, found: Found, failure: Failure) -> Found:
    """Mended, given back, told to resume: until it drives on."""
    if failure.mend is not None:
        failure.mend(drive)
    mended_ns = drive.now_ns
    for _ in range(round(ITSELF_S / 0.05)):
        drive.run(0.05)
        if driving(drive):
            return found._replace(itself=seconds(mended_ns, drive.now_ns))
        if waits_for_somebody(drive):
            break
    drive.run(1.0)
    drive.rover.set_mode("GUIDED")
    drive.rover.arm()
    early = False
    for _ in range(round(WAITS_S / 0.05)):
        drive.run(0.05)
        early |= driving(drive)
    drive.order("resume")
    resumed_ns = drive.now_ns
    for _ in range(200):
        drive.run(0.05)
        if driving(drive):
            return found._replace(resumed=seconds(resumed_ns, drive.now_ns), early=early)
    return found._replace(early=early)


def driving(drive: Drive) -> bool:
    agent = drive.simulation.agents[ROBOT - 1]
    return abs(drive.rover.speed) > MOVES and agent.state.value == "running"


def waits_for_somebody(drive: Drive) -> bool:
    agent = drive.simulation.agents[ROBOT - 1]
    if AWAITED in agent.reason:
        return True
    if not next(m for _, m in reversed(drive.said) if isinstance(m, PlantState) and m.robot == ROBOT).healthy:
        return False
    given = drive.rover.armed and drive.rover.mode == "GUIDED"
    return not given or agent.state.value == "stopped"


def judged(drive: Drive, found: Found) -> Found:
    """With the verdict on the whole drive."""
    result = RunResult(drive.recording())
    said = [
        each for each in (*result.reasons, *result.warnings) if "obot 2" in each or each in result.reasons
    ]
    return found._replace(closest=drive.closest, passed=not result.reasons, sentences=tuple(said))


# ---------------------------------------------------------------------- a second bridge


def second_bridge() -> list[tuple[str, str]]:
    """What becomes of a second one at another port of the vehicle: name, and what is said of it."""
    scene = Scene(ports=3)
    scene.drive()
    later = Bridge(scene.world, 1, scene.fleet)
    later.command = Command(-MASS * 0.5, 0.0)
    scene.bridges.append(later)
    scene.run(10.0)
    later.clear_to_drive()
    scene.run(5.0)
    sent = len(later.setpoints())
    drives = f"the first drives on at {scene.rover.speed:.2f} m/s, {sent} setpoints of the second"
    note = later.reading.note
    scene.bridge.dead = True
    turn = scene.until(lambda: later.setpoints(), 20.0)
    both = Scene(ports=2)
    both.bridges.append(Bridge(both.world, 1, both.fleet))
    for bridge in both.bridges:
        bridge.command = Command(MASS * 0.3, 0.0)
    both.run(8.0)
    counts = [str(len(bridge.setpoints())) for bridge in both.bridges]
    return [
        ("a second bridge at another port", f"{drives}; it says: {note}"),
        ("  the first one ends", f"the second has its turn after {turn:.1f} s"),
        (
            "two bridges that start at once",
            f"{' and '.join(counts)} setpoints; both say: {both.bridge.reading.note}",
        ),
    ]


# ---------------------------------------------------------------------- the table


def run(options: Options) -> Result:
    """See `tests.benchmarks.__main__`."""
    work = Failures(options.count or (ROUNDS_QUICK if options.quick else ROUNDS))
    found = sorted(results("rover_failures", work, len(work.plan)), key=lambda each: each[:3])
    if broken := [f"{ROWS[each.row].name}: {each.trouble}" for each in found if each.trouble]:
        raise BenchmarkError("; ".join(broken))
    result = Result()
    cells, words, verdicts = [], [], []
    for row, failure in enumerate(ROWS):
        mended = [each for each in found if each.row == row and each.mended]
        lost = [each for each in found if each.row == row and not each.mended]
        first = mended[0]
        result.figures += promised(failure, mended)
        cells.append(
            [
                failure.name,
                f"{first.how} {between(each.asks_no_more for each in mended)}",
                between(each.told for each in mended),
                between(each.stood for each in mended),
                between(each.rolled for each in mended),
                between(each.hold for each in mended),
                f"itself {between(each.itself for each in mended)}"
                if first.itself == first.itself
                else f"told {between(each.resumed for each in mended)}",
                outcome(first),
                outcome(lost[0]) if lost else "",
            ]
        )
        said = first.words or (f"(nothing; robot 1: {first.neighbour})",)
        words += [[failure.name if k == 0 else "", text] for k, text in enumerate(said)]
        verdicts += [
            [f"{failure.name}, {'mended' if each.mended else 'for good'}", text]
            for each in (first, *lost)
            for text in each.sentences[:1]
        ]
    result.figures += over_all(found)
    heading = ["failure", "no more asked for, s", "says so, s", "stands, s", "after m"]
    heading += ["other mode, s", "drives on, s", "mended", "for good"]
    result.details = [
        *table(heading, cells),
        "",
        *left(("failure", "what the robot says: state and reason"), words),
        "",
        *left(("failure", "what the verdict says"), verdicts),
        "",
        *left(("two bridges", ""), second_bridge()),
        "",
        "let go: the bridge sends nothing more, or zeros; braked: zeros; itself: the vehicle's own stop.",
        "drives on: itself, after the mending, or told: after a resume, GUIDED and armed being given before.",
    ]
    return result


def promised(failure: Failure, found: Sequence[Found]) -> list[Figure]:
    """What the pages promise of one row, beside the worst that was measured."""
    figures = []
    if failure.limit_s is not None:
        worst = max(each.asks_no_more for each in found)
        figures.append(Figure(f"{failure.name}: {found[0].how} after, at most", worst, "s", failure.limit_s))
    if failure.rolls_m is not None:
        worst = max(each.rolled for each in found)
        figures.append(Figure(f"{failure.name}: rolls, at most", worst, "m", failure.rolls_m))
    return figures


def over_all(found: Sequence[Found]) -> list[Figure]:
    """What holds for all rows."""
    operators = [each for each in found if each.mended and ROWS[each.row].name.startswith("operator")]
    obeyed = max(each.obeyed for each in operators)
    closest = min(found, key=lambda each: each.closest)
    taken = [each for each in found if not each.mended and each.passed]
    others = [ROWS[each.row].name for each in taken if not ROWS[each.row].name.startswith("operator")]
    asked = sum(each.asked for each in found if not ROWS[each.row].passes)
    return [
        Figure("operator: let go after the vehicle has said so, at most", obeyed, "s", LETS_GO_S),
        Figure("setpoints that ask for motion after it was let go or braked", asked, "", 0),
        Figure("drives on before it is told to resume", sum(each.early for each in found), "", 0),
        Figure("closest hand points", closest.closest, "m", SAFE_M, False, note=ROWS[closest.row].name),
        Figure("lost for good, not to its operator, and passed", len(others), "", 0, note=", ".join(others)),
    ]


def between(values: Iterable[float]) -> str:
    """Least and most, of what was to be had."""
    had = [value for value in values if value == value]
    if not had:
        return "-"
    least, most = f"{min(had):.2f}", f"{max(had):.2f}"
    return least if least == most else f"{least} to {most}"


def outcome(found: Found) -> str:
    if not found.passed:
        return "fails"
    return "passes, warns" if found.sentences else "passes"


def left(heading: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table of texts."""
    width = max(len(row[0]) for row in rows)
    return [f"{first.ljust(width)}  {second}".rstrip() for first, second in (heading, *rows)]
