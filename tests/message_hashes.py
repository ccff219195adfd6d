"""SHA-256 over all messages of simulated drives: tells whether a change left behaviour alone, to the bit.

    python tests/message_hashes.py [--only NAME] [--texts]

prints a line for each drive: hash, number of messages, name. Run it in two checkouts and compare the outputs
with `diff`. Keys, payloads and arrival times are hashed as they are put on the bus. Scenarios are read from
`tests/chaos/kept/drawn` beside this script. To drive another checkout with this version of the script:

    cd OTHER && PYTHONPATH=. .venv/bin/python HERE/tests/message_hashes.py

The digest of the fleet file in messages is replaced by a constant. Texts for people (reasons and notes) are
messages too. `--texts` leaves them out, for a change that rewords them.
"""

from __future__ import annotations

import argparse
import hashlib
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import fields, is_dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

FLEETS = {"delta": 30.0, "obstacles": 60.0, "reserve": 60.0, "rovers": 30.0, "lattice45": 20.0}
"""Bundled fleets and for how long they drive (s): reserve long enough for all its orders."""
CHAOS_SEEDS = range(20)
DRAWN = Path(__file__).parent / "chaos/kept/drawn"
ORDERS = """
[[order]]
at = "12s"
kind = "join"
robot = 7
edges = [4, 5]
[[order]]
at = "24s"
kind = "reshape"
scale = 1.5
[[order]]
at = "34s"
kind = "leave"
robot = 4
[[order]]
at = "44s"
kind = "stop"
[[order]]
at = "48s"
kind = "resume"
"""
TEXTS = ("reason", "note", "transition", "text", "message", "what")


def module(*names: str) -> Any:
    """The first of these modules that exists, in `handfast` or, in old checkouts, at the top level."""
    for name in [each for full in names for each in (full, full.removeprefix("handfast."))]:
        try:
            return import_module(name)
        except ModuleNotFoundError as error:
            if error.name is None or not name.startswith(error.name):
                raise
    raise ModuleNotFoundError(f"none of {', '.join(names)}")


def drives() -> list[str]:
    """Names of all drives."""
    return [*FLEETS, *(f"chaos-{seed}" for seed in CHAOS_SEEDS)]


def fleet_of(name: str) -> Any:
    """The resolved fleet of a drive."""
    fleet = module("handfast.agent.fleet.loading", "handfast.agent.fleet.model", "handfast.agent.fleet")
    geometry = module("handfast.agent.formation.geometry", "handfast.agent.formation")
    if name.startswith("chaos-"):
        text = (DRAWN / f"{name.removeprefix('chaos-')}.toml").read_text(encoding="utf-8")
    else:
        arguments = module(
            "handfast.deploy.console.arguments",
            "handfast.deploy.inventory.arguments",
            "handfast.deploy.console.arguments",
        )
        text = arguments.fleet_path(name).read_text(encoding="utf-8")
        if name == "reserve":
            text += ORDERS
    tables = fleet.parse_fleet(text, source=name)
    if name in FLEETS:
        tables = replace(tables, fleet=replace(tables.fleet, duration_s=FLEETS[name]))
    return geometry.resolved(tables)


def without_texts(decode: Callable[[bytes], Any], payload: bytes) -> bytes:
    """What a message says, but for what it says to people."""
    try:
        message = decode(payload)
    except Exception:
        return payload  # not valid, on purpose
    if is_dataclass(message):
        values = {field.name: getattr(message, field.name) for field in fields(message)}
    else:
        values = message._asdict()
    return repr([(k, v) for k, v in values.items() if k not in TEXTS]).encode()


def digest_of(name: str, texts: bool) -> str:
    """The line of one drive."""
    # Before anything imports it from there: the digest changes with every field that fleet files have.
    module("handfast.agent.fleet.loading").digest = lambda fleet: "fleet"
    simulation = module("handfast.deploy.simulate.simulation", "handfast.deploy.simulate.simulation")
    decode = module("handfast.agent.messages.types.codec", "handfast.agent.messages.codec").decode
    sha, count = hashlib.sha256(), 0

    def sink(received_ns: int, key: str, payload: bytes) -> None:
        nonlocal count
        count += 1
        said = payload if texts else without_texts(decode, payload)
        sha.update(b"%d %b %d " % (received_ns, key.encode(), len(said)))
        sha.update(said)

    drive = simulation.Simulation(fleet_of(name), sink)
    drive.run(lambda _: True)
    said = f", said: {'; '.join(drive.reasons)}" if drive.reasons and texts else ""
    return f"{sha.hexdigest()} {count:7d} {name}{said}"


def lines(names: list[str], texts: bool) -> Iterator[str]:
    with ProcessPoolExecutor(2) as pool:
        yield from pool.map(digest_of, names, [texts] * len(names))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--only", action="append", metavar="NAME", help="this drive, repeatedly (default: all)"
    )
    parser.add_argument("--texts", dest="texts", action="store_false", help="leave out texts for people")
    options = parser.parse_args()
    for line in lines(options.only or drives(), options.texts):
        print(line, flush=True)
    sys.exit(0)
