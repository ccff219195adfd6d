"""What units keep robots' processes from, as settings."""

from __future__ import annotations

from dataclasses import replace

import pytest

from handfast.agent.fleet.model import Fleet
from handfast.deploy.hosts import remote_program, systemd_units
from handfast.deploy.hosts.systemd_units import Needs, Places, filters, namespaces, roles, unit
from tests.unit.deploy.hosts.test_systemd_units import fleet, settings

SECURED = Places("/r/versions/1", "/r/two.toml", "/r/keys", "/r/recordings", "/r/state", "/r/orders")
SIMULATED, BRIDGED = 1, 2


def said(robot: int, role: str, of: Fleet | None = None) -> dict[str, str]:
    return settings(unit(of or fleet(), robot, role, SECURED))


def test_every_process_is_kept_from_what_none_needs() -> None:
    for robot in (SIMULATED, BRIDGED):
        for role in roles(fleet()):
            found = said(robot, role)
            assert found["NoNewPrivileges"] == found["RestrictNamespaces"] == found["PrivateUsers"] == "yes"
            assert found["SystemCallFilter"] == "@system-service"
            assert found["RestrictAddressFamilies"] == "AF_INET AF_INET6 AF_UNIX AF_NETLINK"
            assert (found["ProtectSystem"], found["ProtectHome"]) == ("strict", "read-only")
            assert "-%h/.ssh" in found["InaccessiblePaths"].split()
            assert (found["TemporaryFileSystem"], found["BindReadOnlyPaths"]) == (
                "%t:ro", "%t/systemd/notify"
            )  # fmt: skip


@pytest.mark.parametrize(
    ("robot", "role", "folders"),
    [
        (SIMULATED, "agent", "-/r/orders"),
        (SIMULATED, "plant", "-/r/orders -/r/state"),
        (SIMULATED, "recorder", "-/r/recordings/robot-1"),
        (BRIDGED, "plant", "-/r/orders -%h/.local/state/handfast -/tmp"),
    ],
)
def test_it_writes_to_what_is_its_own_alone(robot: int, role: str, folders: str) -> None:
    assert said(robot, role)["ReadWritePaths"] == folders


def test_a_bridge_opens_devices_and_is_found_by_others_who_want_its_connection() -> None:

    bridge, simulated = said(BRIDGED, "plant"), said(SIMULATED, "plant")
    assert {"PrivateDevices", "PrivateTmp"} <= simulated.keys()
    assert {"PrivateDevices", "PrivateTmp"}.isdisjoint(bridge.keys())


def test_what_others_wrote_may_make_code_and_use_hardware_of_its_kind() -> None:
    two = fleet()
    with_law = replace(two, control=replace(two.control, law="mine:Law"))
    assert said(SIMULATED, "agent")["MemoryDenyWriteExecute"] == "yes"
    assert "MemoryDenyWriteExecute" not in said(SIMULATED, "agent", with_law)
    assert "MemoryDenyWriteExecute" in said(SIMULATED, "recorder", with_law)
    lines = [*filters(Needs(others_hardware=True)), *namespaces(Needs(others_hardware=True))]
    assert "RestrictAddressFamilies=AF_INET AF_INET6 AF_UNIX AF_NETLINK AF_CAN AF_BLUETOOTH" in lines
    assert {"PrivateDevices=yes", "ProtectKernelTunables=yes"}.isdisjoint(lines)


@pytest.mark.parametrize(
    ("folder", "shown"),
    [
        ("/home/a b/x", '"-/home/a b/x"'),
        ("/home/50%/x", "-/home/50%%/x"),
        ('/home/"q"/x', '"-/home/\\"q\\"/x"'),
    ],
)
def test_paths_are_written_so_that_systemd_reads_them_as_they_are(folder: str, shown: str) -> None:
    (found,) = [line for line in namespaces(Needs([folder])) if line.startswith("ReadWritePaths=")]
    assert found == f"ReadWritePaths={shown}"


def test_what_need_not_work_can_be_taken_out_and_the_rest_stays() -> None:
    text = unit(fleet(), SIMULATED, "agent", SECURED)
    found = remote_program.TRIED.sub(remote_program.LEFT_OUT, text)
    tried = set(namespaces(Needs())) - {systemd_units.TRIED, systemd_units.UNTIL}
    assert not {line.partition("=")[0] for line in tried} & settings(found).keys()
    assert set(filters(Needs())) <= set(found.splitlines())
    assert len(text.splitlines()) - len(found.splitlines()) == len(tried) + 1
