"""The ways by which commands stop a fleet from here, besides the links that they open."""

from __future__ import annotations

from handfast.agent.fleet.model import Fleet
from handfast.deploy.processes.placement import orders_folder
from handfast.deploy.session.stop import Way
from handfast.deploy.session.stop_by_file import FileWay


def ways(fleet: Fleet) -> list[Way]:
    """Return all there are for `fleet` (located): a file here, and ssh."""
    folder = orders_folder(fleet)
    return [*([FileWay(fleet, folder)] if folder.is_dir() else []), *by_ssh(fleet)]


def by_ssh(fleet: Fleet) -> list[Way]:
    """The way to the hosts of `fleet`, if it has any."""
    hosts = [host for host in fleet.hosts if any(robot.host == host.name for robot in fleet.robots)]
    if not hosts:
        return []
    from handfast.deploy.hosts.stop_by_ssh import SshWay

    return [SshWay(fleet, hosts)]
