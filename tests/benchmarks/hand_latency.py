"""``python -m tests.benchmarks.hand_latency FLEET SECONDS``: how old hand states are when they come.

An operator's session, linked to every agent, hears them for so long. Printed as JSON are their ages (ms, from
the stamp of the tick to the arrival; the clocks of test hosts are one), and how many of those that were due
came from robots that followed the law.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Sequence
from typing import Final, NamedTuple

import zenoh

from agent.fleet.loading import load_fleet
from agent.messages import key_expressions
from agent.messages.codec import decode
from agent.messages.types import HandState
from agent.messages.validation import Malformed
from agent.security.credentials import load
from agent.security.identity import MAIN, of_operator
from agent.transport.bus import RUNTIME, settings_of
from agent.transport.sealed_bus import secured
from deploy.inventory.operator_credentials import keys_folder

SETTLE_S: Final = 1.0
WAITING: Final = 4096


class Heard(NamedTuple):
    """Hand states within some time: ages (ms), and the share of those due that came and `following`."""

    ages_ms: list[float]
    following: float


def listen(fleet_file: str, seconds: float) -> Heard:
    """Listens to all robots for so long, once all links are there."""
    fleet = load_fleet(fleet_file)
    name = fleet.fleet.name
    security = None
    if fleet.is_secured:
        security = secured(fleet, load(keys_folder(name), of_operator(name, MAIN), time.time()))
    os.environ["ZENOH_RUNTIME"] = RUNTIME
    config = zenoh.Config()
    endpoints = [fleet.agent_endpoint(robot) for robot in fleet.ids]
    for path, value in settings_of("peer", [], endpoints, security).items():
        config.insert_json5(path, json.dumps(value))
    ages_ms = []
    following = 0
    # Not by a `Bus`, whose inboxes are looked into once a tick: this one wakes with every message.
    with zenoh.open(config) as session:
        heard = session.declare_subscriber(
            key_expressions.hand(name, "*"), zenoh.handlers.FifoChannel(WAITING)
        )
        begun = time.monotonic()
        for sample in heard:
            now_ns, since = time.time_ns(), time.monotonic() - begun
            if since > SETTLE_S + seconds:
                break
            try:
                message = decode(sample.payload.to_bytes())
            except Malformed:
                continue
            if type(message) is HandState and since > SETTLE_S:
                ages_ms.append((now_ns - message.time_ns) / 1e6)
                following += message.following
    return Heard(ages_ms, following / (len(fleet.ids) * fleet.fleet.rate_hz * seconds))


def main(arguments: Sequence[str]) -> int:
    fleet_file, seconds = arguments
    print(json.dumps(listen(fleet_file, float(seconds))._asdict()))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
