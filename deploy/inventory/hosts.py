"""The hosts of a fleet: where they are, who runs on them, and what all of them read."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Final

from handfast.agent.common.reader import Problem
from handfast.agent.fleet.hosts import HostSection
from handfast.agent.fleet.loading import to_dict
from handfast.agent.fleet.model import Fleet, FleetError
from handfast.deploy.console.arguments import InputError
from handfast.deploy.console.wording import some
from handfast.deploy.inventory import ssh

ASKED_AT_ONCE: Final = 16


def located(fleet: Fleet) -> Fleet:
    """`fleet` with the address of every host that it uses; what it leaves out ssh's configuration knows.

    Raises:
        InputError: that says nothing, or two of them have one address: two sets of processes would fight
            for its files.
    """
    used = {host.name for host in used_hosts(fleet)}
    unknown = [host for host in fleet.hosts if host.name in used and host.address is None]
    found = _addresses(unknown) if unknown else {}
    hosts = []
    first: dict[str, str] = {}
    for host in fleet.hosts:
        if host.name in found:
            host = replace(host, address=found[host.name])
        if host.name in used and host.address is not None:
            other = first.setdefault(host.address.lower(), host.name)
            if other != host.name:
                raise InputError(
                    f"hosts {other} and {host.name} both have the address {host.address}: robots may share a "
                    "host by its name"
                )
        hosts.append(host)
    return replace(fleet, hosts=tuple(hosts))


def _addresses(hosts: Sequence[HostSection]) -> dict[str, str]:
    """Where hosts are, as ssh's configuration says, by name: asked side by side, for a stop waits for it."""

    def address(host: HostSection) -> str:
        try:
            return ssh.address_of(host)
        except ssh.SshError as error:
            raise InputError(f"host {host.name}: {error}") from None

    with ThreadPoolExecutor(min(len(hosts), ASKED_AT_ONCE), "address") as pool:
        return dict(zip((host.name for host in hosts), pool.map(address, hosts), strict=True))


def hosts_of(fleet: Fleet, source: str, only: Sequence[str] = ()) -> list[HostSection]:
    """The hosts that the fleet uses, in the file's order; of these, those that are named in `only`.

    Raises:
        InputError: there is none of that name.
        FleetError: the fleet is not for several machines.
    """
    hosts = used_hosts(fleet)
    if not any(robot.host for robot in fleet.robots):
        message = (
            'no robot has a host: write [host.NAME] for each computer and host = "NAME" in each [[robot]], '
            "or drive it on this machine, `handfast run`"
        )
        raise FleetError(source, [Problem("", message)])
    strangers = sorted(set(only) - {host.name for host in hosts})
    if strangers:
        what = "robots or a router" if any(router.host for router in fleet.routers) else "robots"
        raise InputError(
            f"there is no host {some(strangers)} with {what} in {fleet.fleet.name}; there are: "
            f"{some(host.name for host in hosts)}"
        )
    return [host for host in hosts if not only or host.name in only]


def used_hosts(fleet: Fleet) -> list[HostSection]:
    """The hosts on which robots or routers run, in the file's order."""
    used = {robot.host for robot in fleet.robots} | {router.host for router in fleet.routers}
    return [host for host in fleet.hosts if host.name in used]


def robots_on(fleet: Fleet, host: HostSection) -> tuple[int, ...]:
    """Ids of the robots whose processes run on a host, in the file's order."""
    return tuple(robot.id for robot in fleet.robots if robot.host == host.name)


def refuse_simulated(fleet: Fleet, source: str) -> None:
    """A simulated rover is started by `run` only. `FleetError` where a fleet for hosts has one."""
    problems = [
        Problem(
            f"robot[{number}].mavlink.connection",
            '"simulator" is for `run` and `preflight` on one machine: start `handfast rover-simulator` on '
            "the host and give its port, such as udpin:127.0.0.1:14550",
        )
        for number, robot in enumerate(fleet.robots, 1)
        if robot.is_simulated
    ]
    if problems:
        raise FleetError(source, problems)


def robots_text(fleet: Fleet) -> str:
    """The fleet file that robots read: resolved and located, without how the operator logs in."""
    import tomli_w  # here: only this needs it

    hosts = tuple(HostSection(host.name, host.address, host.listen) for host in fleet.hosts)
    return tomli_w.dumps(to_dict(replace(fleet, hosts=hosts)))
