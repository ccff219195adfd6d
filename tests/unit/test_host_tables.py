"""What is said of hosts and their processes: tables, lines, merged logs."""

from __future__ import annotations

import io
import json
import queue
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any, cast

import pytest

from agent.host_sections import HostSection
from agent.messages import Status
from deploy import logs_command
from deploy.host_connection import Clock
from deploy.hosts_view import Lines, Row
from deploy.interrupt import Interrupt
from deploy.logs_command import Line, Reader
from deploy.status_table import HostStatus, host_rows, print_table, process_row
from tests.unit.test_fleet_hosts import fleet

FLEET = fleet()
UNIT = {
    "ActiveState": "active", "Result": "success", "NRestarts": "2", "cpu_s": 3.0, "age_s": 60.0,
    "memory_bytes": 80e6, "version": "1-aa", "StatusText": "running",
}  # fmt: skip


def status(robot: int) -> Status:
    neighbours = ((2, 20_000, 5, 0, 0, 0), (3, -1, 0, 0, 0, -1))
    return Status(robot, 1, 0, "degraded", "", "without robot 3", 1, 0, neighbours, (), (), ())


def rows(versions: Sequence[str] = ("1-aa", "1-aa")) -> tuple[list[dict[str, Any]], dict[str, HostStatus]]:
    found = {}
    for robot, (name, version) in enumerate(zip(("left", "right"), versions, strict=True), 1):
        unit = {f"handfast-two-robot-{robot}-agent.service": UNIT | {"version": version}}
        found[name] = HostStatus(unit, Clock(0.002, 0.001), 1.5)
    told = [
        process_row(FLEET, robot, role, found[name], status(robot) if robot == 1 else None)
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


def test_a_host_that_cannot_be_asked_is_unknown_not_down() -> None:
    row = process_row(FLEET, 1, "agent", HostStatus(error="it does not answer"), status(1))
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
    print_table(*rows(("1-aa", "1-bb")))
    assert "not all robots run the same (1-aa: robot 1; 1-bb: robot 2)" in capsys.readouterr().out


def test_lines_say_a_thing_once_and_leave_counts_to_the_table() -> None:
    stream = io.StringIO()
    view, row = Lines(stream), Row("left", (1,))
    for step in ("connecting", "connecting", "sending 3 of 49 MB", "sending 40 of 49 MB", "installing"):
        row.step = step
        view.show([row])
    row.fail("the disk is full")
    view.show([row])
    assert stream.getvalue().splitlines() == [
        "left: connecting", "left: sending 49 MB", "left: installing", "left: FAILED: the disk is full",
    ]  # fmt: skip


def reader(host: str, *times_us: int) -> Reader:
    lines: queue.Queue[Line | None] = queue.Queue()
    for time_us in times_us:
        lines.put(Line(time_us, host, str(time_us)))
    lines.put(None)
    return cast(Reader, SimpleNamespace(host=HostSection(host), lines=lines, error=""))


def test_logs_of_several_hosts_come_in_the_order_of_time() -> None:
    readers = [reader("a", 1, 4, 5), reader("b", 2, 3, 9)]
    assert [line.time_us for line in logs_command._merged(readers, None)] == [1, 2, 3, 4, 5, 9]
    readers = [reader("a", 1, 4, 5), reader("b", 2, 3, 9)]
    assert [line.time_us for line in logs_command._merged(readers, 1)] == [5, 9], "the last of each host"


def test_lines_that_are_followed_wait_for_earlier_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(logs_command, "HOLD_S", 0.05)
    readers = [reader("a", 7, 8), reader("b", 6)]
    assert [line.time_us for line in logs_command._followed(readers, Interrupt())] == [6, 7, 8]


@pytest.mark.parametrize(
    ("entry", "text"),
    [
        ({"MESSAGE": "hello"}, "hello"),
        ({"MESSAGE": [104, 105, 255]}, "hi\N{REPLACEMENT CHARACTER}"),
        ({"MESSAGE": "a\x1b[31mb"}, "a\\x1b[31mb"),
    ],
)
def test_a_line_is_safe_to_print(entry: dict[str, Any], text: str) -> None:
    line = logs_command._parsed("a", json.dumps(entry | {"__REALTIME_TIMESTAMP": "17"}).encode())
    assert line == Line(17, "a", text)


def test_what_is_no_entry_is_left_out() -> None:
    assert logs_command._parsed("a", b"-- no entries --") is None
    assert logs_command._parsed("a", b"{}") is None
