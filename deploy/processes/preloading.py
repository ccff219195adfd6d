"""Imported once, by the fork server (`deploy.processes.forking`): all that robots' processes need.

It has one thread and never opens Zenoh: a fork has one thread, and locks that others held stay locked in it.
"""

from __future__ import annotations

import gc
import os
from contextlib import suppress
from importlib import import_module

from handfast.agent.common.errors import Error
from handfast.agent.fleet.plants import DEFAULT, KINDS
from handfast.agent.messages import codec
from handfast.agent.runtime import preloaded
from handfast.deploy.processes import attributes
from handfast.deploy.processes.forking import PRELOAD, end_with


def prepare(parent: int, fleet_file: str) -> None:
    """Make this process the fork server: quiet, out of reach of Ctrl-C, with all loaded."""
    os.setpgid(0, 0)
    end_with(parent)  # a process that its starter has forked may hold the server's pipe open
    null = os.open(os.devnull, os.O_RDWR)
    for standard in (1, 2):
        os.dup2(null, standard)  # processes report in their own logs what this one cannot load
    os.close(null)
    attributes.show(attributes.words_of(__name__, []))
    gc.disable()
    programs = {"handfast.agent", KINDS[DEFAULT].program}
    with suppress(Error):  # each process reports it
        if fleet_file:
            fleet = preloaded.preload(fleet_file)
            programs |= {robot.kind.program for robot in fleet.robots}
            programs |= {robot.kind.simulator for robot in fleet.robots if robot.kind.simulator}
    for program in programs:
        import_module(f"{program}.__main__")
    codec.be_ready()
    # Nothing of this is garbage: looking for some in forked processes would copy every page.
    gc.collect()
    gc.freeze()
    if len(os.listdir("/proc/self/task")) > 1:
        os._exit(1)


if given := os.environ.pop(PRELOAD, ""):
    starter, _, file = given.partition(" ")
    prepare(int(starter), file)
