"""One process of a secured fleet, for `test_security_links.py`.

It says something on its own key 50 times a second, and tells as JSON lines on standard output what it hears,
who is alive, and what was refused.

Arguments: a JSON object with `folder` and `identity` of its credentials, `listen`, `connect`, `routers`. It
ends when standard input does.
"""

from __future__ import annotations

import json
import select
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from handfast.agent.fleet.model import Fleet
from handfast.agent.messages import key_expressions
from handfast.agent.security.credentials import load
from handfast.agent.security.identity import Identity, parse
from handfast.agent.security.refusals import FILTER
from handfast.agent.transport.bus import Bus, Presence, Router, init_log
from handfast.agent.transport.sealed_bus import SealedBus, secured
from handfast.agent.transport.zenoh_log import ZenohLog
from tests.process.fleet_harness import make_fleet
from tests.trusted import FLEET

PERIOD_S = 0.02
SPOKEN = b"x" * 150


def guarded_fleet(routers: Sequence[str] = ()) -> Fleet:
    """A secured fleet of six robots, of the name of the tests' authority."""
    return make_fleet(
        "delta",
        f'fleet.name="{FLEET}"',
        'network.security="mtls"',
        f"network.routers={json.dumps([*routers])}",
    )


def main() -> None:
    """Runs until standard input ends."""
    options = json.loads(sys.argv[1])
    identity, folder = parse(options["identity"]), Path(options["folder"])
    routers = [endpoint.partition("/")[2] for endpoint in options["routers"]]
    fleet = guarded_fleet(routers or ["127.0.0.1:1"])
    if identity.role == "router":
        with ZenohLog() as log:
            init_log(FILTER)
            settings = secured(fleet, load(folder, identity, time.time()))
            with Router(options["listen"], [], settings) as router:
                serve(None, router.watch(key_expressions.everything(FLEET)), log, identity)
        return
    ends = {"listen": options["listen"], "connect": options["connect"], "routers": options["routers"]}
    with SealedBus(fleet, folder, identity, refused, **ends) as bus:
        bus.subscribe(key_expressions.everything(FLEET), 1024)
        serve(bus, bus.watch(key_expressions.everything(FLEET)), None, identity)


def serve(bus: Bus | None, present: Presence, log: ZenohLog | None, identity: Identity) -> None:
    own = None
    if bus is not None and identity.robot is not None:
        own = key_expressions.hand(FLEET, identity.robot)
        bus.announce(key_expressions.alive(FLEET, identity.robot, "agent"))
        bus.declare(own)
    latest: dict[str, float] = {}
    gaps: dict[str, float] = {}
    tell(ready=True)
    while not select.select([sys.stdin], [], [], PERIOD_S)[0] or sys.stdin.read(1):
        if bus is not None:
            if own is not None:
                bus.publish(own, SPOKEN)
            for key, payload in bus.drain():
                now_s = time.monotonic()
                if payload != SPOKEN:
                    tell(got=key, payload=payload.hex())
                    continue
                if key not in latest:
                    tell(heard=key)
                gaps[key] = max(gaps.get(key, 0.0), now_s - latest.get(key, now_s))
                latest[key] = now_s
        for key, here in present.update():
            tell(alive=key, here=here)
        for line in log.lines(time.monotonic_ns()) if log is not None else ():
            refused(line)
    now_s = time.monotonic()
    tell(gaps={key: max(gap, now_s - latest[key]) for key, gap in gaps.items()})


def refused(line: str) -> None:
    tell(refused=line.removeprefix("refused: ").removeprefix("refused "))


def tell(**what: Any) -> None:
    print(json.dumps(what), flush=True)


if __name__ == "__main__":
    main()
