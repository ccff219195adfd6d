"""What `handfast up` says of serial ports, by what a host tells of them."""

from __future__ import annotations

from typing import Any

import pytest
import tomli_w

from handfast.agent.fleet.hosts import HostSection
from handfast.agent.fleet.loading import parse_fleet
from handfast.agent.fleet.model import Fleet
from handfast.deploy.hosts.connection import HostError
from handfast.deploy.hosts.setup import port_warnings
from tests.unit.deploy.hosts.test_preflight import tables


class Host:
    """A host on which robots 1 and 2 are, that says this of their ports."""

    def __init__(self, told: Any) -> None:
        self.host, self.about = HostSection("rover1"), {"user": "pi"}
        self.told = told
        self.asked: list[Any] = []

    def ask(self, what: str, **arguments: Any) -> Any:
        self.asked.append((what, arguments))
        return self.told


def fleet(first: str = "/dev/serial0", second: str = "udpin:127.0.0.1:14550") -> Fleet:
    raw = tables()
    for robot, connection in zip(raw["robot"], (first, second), strict=False):
        robot |= {"host": "rover1", "mavlink": {"connection": connection}}
    return parse_fleet(tomli_w.dumps(raw), source="here")


def warnings(**found: Any) -> list[str]:
    return port_warnings(Host({"/dev/serial0": found}), fleet())  # type: ignore[arg-type]


def test_nothing_is_asked_of_a_host_without_serial_ports_and_nothing_said_of_one_that_is_well() -> None:
    host = Host({})
    assert port_warnings(host, fleet("tcp:10.0.0.1:5760")) == []  # type: ignore[arg-type]
    assert host.asked == []
    assert warnings() == []


@pytest.mark.parametrize(
    ("found", "words"),
    [
        ({"there": []}, "is not there, nor any other: connect it, or correct mavlink.connection"),
        ({"there": ["/dev/ttyACM0"]}, "is not there, there is /dev/ttyACM0: connect it"),
        ({"there": ["/dev/a", "/dev/b"]}, "is not there, there are /dev/a, /dev/b: connect it"),
        ({"kind": "a folder"}, "is a folder, no serial port: correct mavlink.connection"),
        ({"denied": "dialout"}, "is for the group dialout, and pi is not in it: sudo usermod -aG dialout pi"),
        ({"denied": ""}, "is for its owner alone"),
        ({"late": "dialout"}, "pi is in the group dialout, but was not when its systemd began"),
        ({"console": "a login"}, "a login is on it, and would speak to the vehicle: take console=..."),
        ({"modem": True}, "ModemManager runs there"),
    ],
)
def test_each_thing_that_is_wrong_is_said_with_the_robot_and_what_to_do(
    found: dict[str, Any], words: str
) -> None:
    (told,) = warnings(**found)
    assert told.startswith(f"robot 1: /dev/serial0: {words}")
    assert "\n" not in told


def test_several_things_are_several_sentences_and_two_robots_are_told_apart() -> None:
    assert len(warnings(denied="dialout", console="the kernel's console")) == 2
    host = Host({"/dev/a": {"there": []}, "/dev/b": {}})
    told = port_warnings(host, fleet("/dev/a", "/dev/b"))  # type: ignore[arg-type]
    assert len(told) == 1
    assert host.asked == [("ports", {"paths": ["/dev/a", "/dev/b"]})]


@pytest.mark.parametrize("told", [None, {}, [], {"/dev/serial0": 3}, {"/dev/serial0": {"there": 5}}])
def test_an_answer_that_makes_no_sense_is_a_hosts_error(told: Any) -> None:
    with pytest.raises(HostError, match="makes no sense"):
        port_warnings(Host(told), fleet())  # type: ignore[arg-type]
