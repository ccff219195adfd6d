"""A secured fleet that is attacked while it drives: nobody gets in, nobody disturbs it, and all is logged."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Final

import numpy as np
import pytest

from handfast.agent.common.time import NS_PER_S
from handfast.agent.messages import key_expressions
from handfast.agent.messages.codec import encode
from handfast.agent.messages.types import HandState, Heartbeat, Resume, Status, Stop
from handfast.deploy.drive.preconditions import OVER
from handfast.deploy.inventory.operator_credentials import KEYS
from handfast.deploy.recording.mcap_reader import read_run
from tests.process import attackers
from tests.process.harness import Command, measured, no_trouble_in_logs
from tests.process.same_way import assert_same_way
from tests.process.secured_fleet import EAR, TAKEN, SecuredRobots, secured_robots, three

SLOW = ("fleet.rate_hz=25", "control.wrench_timeout_s=0.5", "control.plant_timeout_s=0.5")
"""Robots shall be judged, not the scheduler of a busy machine."""
DEADMAN_S = 2.0
DRIVE_S = 16.0
ROUND_S = 0.1
ROUNDS = 20
"""Of what a robot that was taken over says: thousands of messages."""
AGREE_M = 0.05
NEAR_M = 0.02
OUT: Final = ("--out", "out", "--no-report")
HONEST: Final = (1, 3)
LONG_BEFORE, BEFORE = "long before", "before"


@pytest.fixture
def overrides() -> tuple[str, ...]:
    return ()


@pytest.fixture
def fleet(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, overrides: tuple[str, ...]
) -> Iterator[SecuredRobots]:
    """Stands ready, and was told to stop, twice, and to go on before."""
    with secured_robots(three(*SLOW, *overrides), tmp_path / "r") as all_robots:
        monkeypatch.setenv(KEYS, str(all_robots.keys.of(all_robots.keys.operator())))
        now_ns, name = time.time_ns(), all_robots.name
        version = now_ns // 1_000
        for stop in (Stop(version, now_ns, LONG_BEFORE), Stop(version + 1, now_ns, BEFORE)):
            all_robots.bus.publish(key_expressions.stop(name), encode(stop))
        all_robots.wait_until_all("stopped")
        all_robots.bus.publish(key_expressions.resume(name), encode(Resume(version + 2, now_ns, ())))
        all_robots.wait_until_all("ready")
        yield all_robots
        assert not all_robots.died(), all_robots.told()
        no_trouble_in_logs(all_robots.folder)


def drive(fleet: SecuredRobots, duration_s: float) -> Command:
    return fleet.command("drive", *OUT, "--duration", f"{duration_s:g}")


def lacking(fleet: SecuredRobots, where: tuple[tuple[int, str], ...], *texts: str) -> str:
    """The first of `texts` that is not in one of these logs, "" when all are."""
    for process in where:
        log = fleet.log_of(*process)
        for text in texts:
            if f"refused: {text}" not in log:
                return f"robot {process[0]}'s {process[1]}: {text}"
    return ""


def in_rounds(
    fleet: SecuredRobots, do: Callable[[], None], done: Callable[[], bool], lacks: Callable[[], str]
) -> None:
    """Does something again and again until it is `done`; `lacks` says what is missing else."""
    due_s = time.monotonic()

    def next_round() -> bool:
        nonlocal due_s
        if time.monotonic() < due_s:
            return False
        due_s = time.monotonic() + ROUND_S
        do()
        return done()

    try:
        fleet.wait(next_round, "the end of an attack")
    except AssertionError as error:
        raise AssertionError(f"not told: {lacks()}") from error


def until_told(
    fleet: SecuredRobots, where: tuple[tuple[int, str], ...], do: Callable[[], None], *texts: str
) -> None:
    """Does something in rounds until all these logs have all `texts`."""
    in_rounds(
        fleet, do, lambda: not lacking(fleet, where, *texts), lambda: lacking(fleet, where, *texts)
    )  # fmt: skip


@pytest.mark.alone
def test_attacks_in_the_middle_of_a_drive(fleet: SecuredRobots, tmp_path: Path) -> None:
    at, name = fleet.keys, fleet.name
    agents = tuple((robot, "agent") for robot in HONEST)
    both = (*agents, *((robot, "plant") for robot in HONEST))
    endpoints = [fleet.endpoints[process] for process in both]
    told, hand = key_expressions.relayed(name, TAKEN), key_expressions.hand(name, TAKEN)

    with drive(fleet, DRIVE_S) as command, ExitStack() as stack:
        command.wait_for_line(r"(?m)^ +[1-9]\.\d s .* all running")
        slowly = stack.enter_context(attackers.sockets(endpoints))

        # Who has no certificate of the fleet.
        for who, (why, settings) in attackers.strangers(at).items():
            with attackers.attacks(
                [each.replace("tls/", "tcp/") if who == "plain TCP" else each for each in endpoints], settings
            ) as session:

                def say_all(session: attackers.zenoh.Session = session) -> None:
                    slowly()
                    attackers.say_as_others(session.put, fleet.fleet, at, fleet.ear.given)
                    session.liveliness().declare_token(key_expressions.alive(name, 1, "agent")).undeclare()

                until_told(fleet, both, say_all, f"a connection of somebody: {why}")
                assert not list(session.info.peers_zid()), who

        # Who has: a robot's, on a computer of the attacker's and over the links of its own agent.
        settings = at.security(at.robot(TAKEN)).settings()
        robot_2 = stack.enter_context(attackers.attacks(endpoints, settings))
        attackers.heard(robot_2, key_expressions.wrench(name, 1), key_expressions.beacon(name, TAKEN), told)
        settings = at.security(at.operator(EAR)).settings()
        anna = stack.enter_context(attackers.attacks(endpoints, settings))
        attackers.heard(anna, key_expressions.faults(name), key_expressions.heartbeat(name))
        tokens = [
            key_expressions.alive(name, robot, role) for robot in HONEST for role in key_expressions.ROLES
        ]
        rounds = said = 0

        def count(say: attackers.Say) -> attackers.Say:
            def counted(key: str, payload: bytes) -> None:
                nonlocal said
                said += 1
                say(key, payload)

            return counted

        def attack() -> None:
            nonlocal rounds
            rounds += 1
            say = count(robot_2.put if rounds % 2 else fleet.says)
            attackers.say_as_others(say, fleet.fleet, at, fleet.ear.given)
            now_ns = time.time_ns()
            of_robot_1 = [encode(m) for _, m in fleet.since(now_ns - NS_PER_S, HandState, 1)][:2]
            more = attackers.OVERSIZED if rounds % 10 < 2 else of_robot_1
            attackers.say_on_own_keys(say, fleet.fleet, at, fleet.ear.given, more, rounds // 2)
            for token in tokens:
                robot_2.liveliness().declare_token(token).undeclare()
                fleet.says(token, b"")
            # Somebody whose link lets orders in repeats old ones.
            for key, payload in (fleet.ear.given | attackers.overheard(fleet.fleet, at)).items():
                anna.put(key, payload)
            anna.put(hand, attackers.as_robot(name, TAKEN, now_ns)[hand])
            slowly()

        robots_2, annas = f"{name}.robot.{TAKEN}", f"{name}.operator.{EAR}"
        until_told(
            *(fleet, both, attack),
            f"a message of {robots_2} that it may not send, or that is too large",
            f"an order on {key_expressions.faults(name)}: sealed long ago",
        )
        forged = [
            f"an order on {told}: {why}"
            for why in ("malformed", "oversized", "not an operator", "unknown authority", "bad signature")
        ]
        long_ago = [
            f"an order on {key(name)}: sealed long ago"
            for key in (key_expressions.heartbeat, key_expressions.ask)
        ]
        until_told(fleet, agents, attack, *forged, *long_ago, f"a message of {annas} that it may not send")
        told_operator = [f"handfast: refused: {text}" for text in (f"a message of {robots_2}", *forged)]
        in_rounds(
            *(fleet, attack),
            lambda: rounds >= ROUNDS and all(text in command.err for text in told_operator),
            lambda: f"{rounds} rounds; {told_operator} in {command.err}",
        )
        measured("said, messages", said)
        measured("attacked until, s", time.monotonic() - command.begun)
        assert command.process.poll() is None, "the drive was over before the attacks were"
        fleet.wait(lambda: command.process.poll() is not None, "the end of the drive")
        assert command.wait() == 0, command.told()

    folder = command.out_file.parent / "out"
    drove_as_if_alone(fleet, folder, tmp_path)


def drove_as_if_alone(fleet: SecuredRobots, folder: Path, other: Path) -> None:
    """What was recorded is what the same fleet does in a simulation, with no orders but its operator's."""
    metrics, recording = json.loads((folder / "metrics.json").read_text()), read_run(folder)
    assert metrics["verdict"]["passed"], metrics["verdict"]
    # A busy machine may have them drive at a lower rate for a while.
    warnings = [each for each in metrics["verdict"]["warnings"] if "was too slow, or" not in each]
    assert not warnings, metrics["verdict"]
    assert len(recording.missions) == 1
    assert {stop.reason for stop in recording.stops} <= {LONG_BEFORE, BEFORE, OVER}
    assert len(recording.resumes) <= 1
    assert not recording.live_faults
    for robot in fleet.members:
        status = recording.robots[robot].status
        within = (status.t > 0.1) & (status.t < DRIVE_S - 0.1)
        told = {(status.states[k], status.reasons[k]) for k in np.flatnonzero(within)}
        assert {state for state, why in told if not why.startswith("overloaded: ")} == {"running"}, told
        assert len({*status.mission_versions[within]}) == len({*status.order_versions[within]}) == 1
        measured(f"ticks missed by robot {robot}", status.totals()["overruns"])
    for robot in HONEST:
        rejected = recording.robots[robot].status.totals()
        for reason in ("malformed", "not_finite", "oversized", "checksum", "wrong_key", "out_of_order"):
            assert rejected.get(f"rejected.{reason}", 0) > 0, (reason, rejected)

    with Command(other, "simulate", str(fleet.fleet_file), *OUT, "--duration", f"{DRIVE_S:g}") as command:
        assert command.wait() == 0, command.told()
    alone = json.loads((other / "out" / "metrics.json").read_text())
    for kind, least in alone["min_distance_m"].items():
        assert abs(metrics["min_distance_m"][kind] - least) < NEAR_M, (kind, metrics["min_distance_m"], alone)
    assert_same_way(folder, other / "out", DRIVE_S, AGREE_M)


@pytest.mark.long
@pytest.mark.parametrize("overrides", [(f"supervision.deadman_s={DEADMAN_S}",)])
def test_old_heartbeats_keep_nobody_driving(fleet: SecuredRobots) -> None:
    """Who has overheard an operator cannot stand in for it once it is gone."""
    at, name = fleet.keys, fleet.name
    key = key_expressions.heartbeat(name)
    endpoints = [fleet.endpoints[robot, "agent"] for robot in fleet.fleet.ids]
    with (
        drive(fleet, 60.0) as command,
        attackers.attacks(endpoints, at.security(at.operator(EAR)).settings()) as anna,
        attackers.attacks(endpoints, at.security(at.robot(TAKEN)).settings()) as robot_2,
    ):
        attackers.heard(anna, key)
        attackers.heard(robot_2, key_expressions.beacon(name, TAKEN))
        beats = attackers.overheard(fleet.fleet, at)[key]
        command.wait_for_line(r"(?m)^ +[1-9]\.\d s .* all running")
        command.process.kill()
        gone_ns = time.time_ns()
        held: dict[int, int] = {}

        def replay() -> None:
            fresh = attackers.sealed(
                at.files(at.robot(TAKEN)), encode(Heartbeat(time.time_ns(), "attack")), time.time_ns()
            )
            for session in (anna, robot_2):
                session.put(key, beats)
                session.put(key, fresh)
            for robot in fleet.members:
                for _, status in fleet.since(gone_ns, Status, robot):
                    if status.state == "holding" and robot not in held:
                        assert status.reason.startswith("no operator's heartbeat"), status
                        held[robot] = status.time_ns

        in_rounds(fleet, replay, lambda: len(held) == len(fleet.members), lambda: f"who holds: {held}")
        measured("held after the operator was gone, s", (max(held.values()) - gone_ns) / NS_PER_S)
        # It goes on, and they stay where they are.
        until_ns = max(held.values()) + NS_PER_S
        in_rounds(fleet, replay, lambda: time.time_ns() > until_ns, lambda: "")
        for robot in fleet.members:
            late = [m.state for _, m in fleet.since(held[robot], Status, robot)]
            assert len(late) > 2
            assert set(late) == {"holding"}, late
    assert not lacking(
        fleet, ((1, "agent"),), f"an order on {key}: sealed long ago", f"an order on {key}: not an operator"
    )
