"""A large fleet, whose simulated bodies share a process: seen, driven and killed."""

from __future__ import annotations

import os
import re
import signal
from pathlib import Path

import pytest

from handfast.agent.messages.key_expressions import ROLES
from handfast.deploy.analysis.lattice import lattice
from tests.process.harness import Command, children, last_lines, running, wait_for
from tests.process.test_run import assert_complete

pytestmark = [pytest.mark.long, pytest.mark.alone]
NETWORK = ("--set", "network.base_port=21800")
ROBOTS = 26
ALONE = 7
"""The robot whose plant a rule starts anew: that has a process of its own."""
RULE = f'faults.rule = [{{ name = "again", robot = {ALONE}, restart = "plant", at = 2 }}]\n'
DRIVE_S = 8.0


def drive(folder: Path, *more: str, rule: str = "") -> Command:
    file = folder / "many.toml"
    file.write_text(rule + lattice("many", ROBOTS, rate_hz=5.0))
    out = folder / "out"
    return Command(folder, "run", str(file), "--out", str(out), "--no-report", *NETWORK, *more)


def processes_of(command: Command, module: str = "plant") -> dict[int, str]:
    """Processes of a module, that with bodies unless another is named, and their command lines."""
    everybody = [command.process.pid, *children(command.process.pid)]
    found = {pid: text for parent in everybody for pid, text in children(parent).items()}
    return {pid: text for pid, text in found.items() if f"-m {module} " in text}


def test_a_large_fleet_drives_with_its_bodies_in_one_process(tmp_path: Path) -> None:
    """But for that to which a rule does something; each is seen, logged and recorded by itself."""
    with drive(tmp_path, "--duration", f"{DRIVE_S:g}", rule=RULE) as command:
        told = command.wait_for_line(r"(?m)^starting 26 agents and 26 plants, (.*) on ports ")
        assert told[1] == "25 of them in 1 process,"
        assert command.wait_for_line(r"all (\d+) processes alive after")[1] == "28"
        shared, alone = sorted(processes_of(command).values(), key=lambda text: "--with=" not in text)
        others = ",".join(str(robot) for robot in range(2, ROBOTS + 1) if robot != ALONE)
        assert re.search(rf"--robot 1 .*--with={others} ", shared), shared
        assert f"--robot {ALONE} " in alone, alone
        assert command.wait(DRIVE_S + 60.0) == 0, command.told()
    assert f"rule 'again' started robot {ALONE}'s plant" in command.err
    assert "did not end" not in command.err, "it ends when asked"
    assert_complete(tmp_path / "out", report=False)
    for robot in range(1, ROBOTS + 1):
        for role in ROLES:
            assert (tmp_path / "out" / "logs" / f"robot-{robot}-{role}.log").exists()
        said = (tmp_path / "out" / "logs" / f"robot-{robot}-plant.log").read_text()
        assert f"robot {robot} plant: driving\n" in said, said
    assert (
        last_lines(tmp_path / "out" / "logs" / "robot-1-plant.log")[-1] == "robot 1 plant: ending (SIGTERM)"
    )


def test_a_stop_of_all_of_them_is_known_to_be_kept_while_the_router_stands(tmp_path: Path) -> None:
    """No link is needed: agents and bodies find it in their folder, and say there that they have it."""
    with drive(tmp_path, "--duration", "60") as command:
        command.wait_until_driving()
        (router,) = processes_of(command, "handfast.agent.runtime.router")
        os.kill(router, signal.SIGSTOP)
        with Command(tmp_path / "stop", "stop", str(command.process.pid)) as stop:
            assert stop.wait() == 0, stop.told()
        all_of_them = rf"{ROBOTS} of {ROBOTS} robots brake, the last after \d+ ms"
        ways = rf"{all_of_them} \({ROBOTS} by a file on this machine\)"
        assert re.fullmatch(ways, stop.out.strip()), stop.told()
        assert not stop.err, stop.told()
        os.kill(router, signal.SIGCONT)
        command.process.send_signal(signal.SIGINT)
        assert command.wait() == 130, command.told()


def test_the_end_of_the_process_of_many_bodies_is_told_and_ends_the_run(tmp_path: Path) -> None:
    with drive(tmp_path, "--duration", "60") as command:
        command.wait_until_driving()
        (pool,) = processes_of(command)
        pids = list(command.children())
        os.kill(pool, signal.SIGKILL)
        assert command.wait() == 1, command.told()
        wait_for(lambda: not any(map(running, pids)), "the end of all processes")
    said = r"The plants of 26 robots \(1-26\) ended at \d+\.\d s \(killed by SIGKILL\)\."
    assert re.search(said, command.err), command.told()
