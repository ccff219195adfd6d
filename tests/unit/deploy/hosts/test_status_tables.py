"""What is said of hosts and their processes: tables and lines."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from handfast.agent.messages.types import Status
from handfast.agent.security.certificates import DAY_S
from handfast.agent.security.identity import of_robot, of_router
from handfast.deploy.hosts.connection import Clock, HostError
from handfast.deploy.hosts.jobs import Lines, Row
from handfast.deploy.hosts.status import (
    HostStatus,
    expiries_on_hosts,
    host_rows,
    host_status,
    print_table,
    process_row,
    router_rows,
)
from handfast.deploy.inventory.certificate_authority import CERTIFICATE_DAYS
from tests.trusted import NOW_S, authority, credentials
from tests.unit.agent.fleet.test_hosts import HOSTS, LEFT, ROUTERS, fleet

FLEET = fleet()
UNIT = {
    "ActiveState": "active", "Result": "success", "NRestarts": "2", "cpu_s": 3.0, "age_s": 60.0,
    "memory_bytes": 80e6, "version": "1-aa-77", "StatusText": "running",
}  # fmt: skip


def status(robot: int) -> Status:
    neighbours = ((2, 20_000, 5, 0, 0, 0), (3, -1, 0, 0, 0, -1))
    return Status(robot, 1, 0, "degraded", "", "without robot 3", 1, 0, neighbours, (), (), ())


def rows(
    versions: Sequence[str] = ("1-aa-77", "1-aa-77"),
) -> tuple[list[dict[str, Any]], dict[str, HostStatus]]:
    found = {}
    for robot, (name, version) in enumerate(zip(("left", "right"), versions, strict=True), 1):
        unit = {f"handfast-two-robot-{robot}-agent.service": UNIT | {"version": version}}
        found[name] = host_status({"units": unit, "load": 1.5, "certificates": {}}, Clock(0.002, 0.001))
    told = [
        process_row(FLEET, robot, role, found[name], status(robot) if robot == 1 else None, 0.0)
        for robot, name in ((1, "left"), (2, "right"))
        for role in ("plant", "agent")
    ]
    return told, found


def test_a_row_has_what_the_host_and_the_robot_say() -> None:
    plant, agent, _, silent = rows()[0]
    assert (plant["unit"], plant["state"]) == ("none", None)
    assert agent["unit"] == "active"
    assert agent["restarts"] == 2
    assert agent["cpu_percent"] == pytest.approx(5.0)
    assert (agent["state"], agent["reason"]) == ("degraded", "without robot 3")
    assert agent["oldest_ms"] == 20.0, "of those that were heard"
    assert (silent["unit"], silent["state"]) == ("active", None)


@pytest.mark.parametrize(
    "told",
    [
        [],
        {"units": {"a.service": UNIT}},
        {"units": {"a.service": UNIT}, "load": 1.0},
        {"units": {"a.service": UNIT}, "load": 1.0, "certificates": 7},
        {"units": [], "load": 1.0},
        {"units": {"a.service": 7}, "load": 1.0},
        {"units": {"a.service": UNIT | {"cpu_s": "much"}}, "load": 1.0},
        {"units": {"a.service": UNIT | {"NRestarts": "often"}}, "load": 1.0},
    ],
)
def test_a_host_that_says_nonsense_is_told_from_one_that_is_well(told: Any) -> None:
    with pytest.raises(HostError, match="makes no sense"):
        host_status(told, Clock(0.0, 0.1))


def test_how_long_certificates_hold(tmp_path: Path) -> None:
    name = FLEET.fleet.name
    with authority(tmp_path, NOW_S, name) as by:
        pem = credentials(by, tmp_path / "r", of_robot(name, 2)).files.certificate.read_text()
    told = {
        "units": {},
        "load": 1.0,
        "certificates": {f"{name}.robot.2.crt": pem, f"{name}.robot.1.crt": "half", "x": pem},
    }
    host = host_status(told, Clock(0.0, 0.1))
    assert host.expiries == {of_robot(name, 2): NOW_S + CERTIFICATE_DAYS * DAY_S}
    days = {
        robot: process_row(FLEET, robot, "agent", host, None, NOW_S + 10 * DAY_S)["certificate_days"]
        for robot in (1, 2)
    }
    assert days == {2: CERTIFICATE_DAYS - 10, 1: None}
    apart, together = fleet(), fleet(HOSTS, LEFT, LEFT)
    assert expiries_on_hosts(apart, {"left": host}, "f.toml") == [], "it says so of another's"
    (found,) = expiries_on_hosts(together, {"left": host}, "f.toml")
    assert found.warning(NOW_S) == ""
    late_s = NOW_S + (CERTIFICATE_DAYS - 3) * DAY_S
    assert (
        found.warning(late_s)
        == "the certificate of robot 2 expires in 3 days: `handfast up f.toml` renews it"
    )


def test_a_router_on_a_host_has_a_row_of_its_own(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    routed = fleet(HOSTS + ROUTERS % "left")
    left, right = routed.hosts
    with authority(tmp_path, NOW_S, "two") as by:
        pem = credentials(by, tmp_path / "r", of_router("two", "1")).files.certificate.read_text()
    units = {"handfast-two-router.service": UNIT | {"StatusText": "router of two on tls/10.0.0.1:7604"}}
    told = {"units": units, "load": 1.0, "certificates": {"two.router.1.crt": pem}}
    host = host_status(told, Clock(0.0, 0.1))
    (row,) = router_rows(routed, left, host, NOW_S)
    assert (row["robot"], row["host"], row["role"], row["unit"]) == (None, "left", "router", "active")
    assert row["certificate_days"] == CERTIFICATE_DAYS
    assert router_rows(routed, right, host, NOW_S) == []
    (found,) = expiries_on_hosts(routed, {"left": host, "right": host}, "f.toml")
    assert found.who == "router 1"
    print_table([row], {"left": host})
    (line,) = (line for line in capsys.readouterr().out.splitlines() if "router of two" in line)
    assert line.split()[:4] == ["-", "left", "router", "active"]


def test_a_host_that_cannot_be_asked_is_unknown_not_down() -> None:
    row = process_row(FLEET, 1, "agent", HostStatus(error="it does not answer"), status(1), 0.0)
    assert (row["unit"], row["state"]) == ("unknown", "degraded")
    about = host_rows({"left": HostStatus(error="it does not answer")})["left"]
    assert about == {
        "error": "it does not answer",
        "clock_offset_s": None,
        "clock_error_s": None,
        "load": None,
    }


def test_the_table_tells_all_of_it(capsys: pytest.CaptureFixture[str]) -> None:
    told, found = rows()
    found["right"] = HostStatus(error="it does not answer")
    print_table(told, found)
    out = capsys.readouterr().out
    assert "left: clock 2.0 ms ahead (within 1.0 ms), load 1.5" in out
    assert "right: it does not answer" in out
    assert "without robot 3" in out
    assert "version 1-aa" in out
    print_table(*rows(("1-aa-77", "1-aa-88")))
    assert "version 1-aa\n" in capsys.readouterr().out, (
        "other wheels for another processor are no other version"
    )
    print_table(*rows(("1-aa-77", "1-bb-77")))
    assert "not all robots run the same (1-aa: robot 1; 1-bb: robot 2)" in capsys.readouterr().out


def test_anybodys_words_are_text(capsys: pytest.CaptureFixture[str]) -> None:
    told, found = rows()
    told[0]["state"], told[0]["reason"] = "stopped", "[/x] [red]lunch\x1b[2J"
    print_table(told, found)
    assert "[/x] [red]lunch\\x1b[2J" in capsys.readouterr().out


MANY = 300


def many_rows() -> list[Row]:
    return [Row(f"host{number}", (number,)) for number in range(1, MANY + 1)]


def test_of_many_hosts_those_that_fail_are_said_and_the_rest_summed_up() -> None:
    stream = io.StringIO()
    view, shown = Lines(stream), many_rows()
    view.show(shown)
    assert stream.getvalue() == ""
    shown[6].fail("it does not answer")
    for row in shown[:150]:
        if row is not shown[6]:
            row.done("down, 3 units ended and removed")
    view.show(shown)
    view.show(shown)
    assert stream.getvalue().splitlines() == [
        "host7: FAILED: it does not answer", "149 of 300 hosts done, 1 failed, 150 under way",
    ]  # fmt: skip
    for row in shown[150:]:
        row.done("down, there was nothing")
    stream.truncate(stream.seek(0))
    view.show(shown)
    assert stream.getvalue().splitlines() == [
        "299 of 300 hosts done, 1 failed",
        "149 hosts: down, 3 units ended and removed",
        "150 hosts: down, there was nothing",
    ]
