"""A pair of robots on two hosts, and operators who each have a computer, that is: keys and a clock of their
own."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from handfast.deploy.inventory.operator_credentials import KEYS, OPERATOR
from tests.hosts.fleet_on_hosts import FleetOnHosts
from tests.hosts.hosts import Hosts
from tests.process.harness import wait_for

NAME: Final = "pair"
ANNA: Final = "anna"


def pair(hosts: Hosts) -> dict[str, Any]:
    """The tables of a fleet file; both operators give orders."""
    return {
        "fleet": {"name": NAME, "rate_hz": 25.0, "duration_s": 60.0},
        "formation": {"edges": [[1, 2]], "distance_m": 1.0, "safe_distance_m": 0.2},
        "control": {"wrench_timeout_s": 0.5, "plant_timeout_s": 0.5},
        "network": {"operators": ["main", ANNA]},
        "trajectory": {"kind": "hold"},
        "host": {host.name: {"address": host.address} for host in hosts},
        "robot": [
            {"id": number, "x_m": 1.0 * number, "y_m": 0.0, "host": host.name}
            for number, host in enumerate(hosts, 1)
        ],
    }


class Operated(FleetOnHosts):
    """A fleet with operators."""

    keys: Path
    who = "main"
    ahead_s = 0.0

    def of(self, who: str, folder: str, ahead_s: float = 0.0) -> Operated:
        """Commands are this operator's from now on, with the keys in a folder, and a wall clock that is so
        far ahead."""
        self.who, self.keys, self.ahead_s = who, self.folder / folder, ahead_s
        return self

    def words(self, command: str, *arguments: str) -> list[str]:
        right = super().words(command, *arguments)
        if not self.ahead_s:
            return right
        module = right.index("-m")
        clock = ["-m", "tests.process.set_clock", str(self.ahead_s)]
        return [*right[:module], *clock, *right[module + 1 :]]

    def environment(self) -> dict[str, str]:
        own = {KEYS: str(self.keys), OPERATOR: self.who}
        own["XDG_STATE_HOME"] = str(self.folder / f"{self.keys.name}-state")
        return super().environment() | own


def states(fleet: FleetOnHosts) -> dict[int, str | None]:
    """What `handfast status` says that each robot's agent does."""
    return {robot: row["state"] for (robot, role), row in fleet.status().items() if role == "agent"}


def drives(fleet: FleetOnHosts) -> None:
    """Has the fleet drive, with nobody there."""
    fleet.handfast("drive", "--detach", "--resume")
    wait_for(lambda: set(states(fleet).values()) == {"running"}, "all drive", 30.0)


def enroll(fleet: Operated, who: str) -> None:
    """Has main sign a certificate for another operator."""
    asked, signed = str(fleet.folder / f"{who}.csr"), str(fleet.folder / f"{who}.crt")
    fleet.of(who, who).handfast("keys", "--request", "--out", asked)
    fleet.of("main", "main").handfast("keys", "--sign", asked, "--out", signed)
    fleet.of(who, who).handfast("keys", "--install", signed)


def stopped(fleet: Operated, reason: str) -> None:
    """Waits until systemd says so of all, without the fleet's network or anybody's clock."""

    def said() -> list[str]:
        found = []
        for robot, host in enumerate(fleet.hosts, 1):
            unit = f"handfast-{fleet.name}-robot-{robot}-agent"
            told = host.run(["systemctl", "--user", "show", "-P", "StatusText", unit], check=True)
            found.append(told.stdout.strip())
        return found

    wait_for(lambda: said() == [f"stopped: stop: {reason}"] * 2, f"all stand for {reason}", 3.0)
