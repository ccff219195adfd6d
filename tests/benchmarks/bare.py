"""A bare Zenoh program: moves the same messages as an agent or a plant, and computes nothing.

The yardstick of `cpu.py`, written as lean as a competent programmer would: one script for both
roles, no imports but Zenoh, one ring per key drained once a tick, absolute deadlines, ready-made
payloads. What it is to do comes as one JSON object::

    {"listen": [...], "connect": [...], "subscribe": [key, ...], "alive": key,
     "publish": [[key, size, every], ...], "period_ns": n, "phase_ns": n, "config": {...}}

A message of `size` bytes goes out on `key` at each tick whose number `every` divides.
"""

import gc
import json
import os
import signal
import sys
import time

import zenoh

INBOX_SIZE = 32


def main() -> None:
    order = json.loads(sys.argv[1])
    parent = os.getppid()
    asked = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: asked.append(True))
    settings = {
        "mode": "peer",
        "listen/endpoints": order["listen"],
        "connect/endpoints": order["connect"],
        "connect/retry": {"period_init_ms": 50, "period_max_ms": 200, "period_increase_factor": 2},
        "connect/exit_on_failure": False,
        "open/return_conditions": {"connect_scouted": False, "declares": False},
        "scouting/delay": 0,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        **order.get("config", {}),
    }
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    period_ns, phase_ns = order["period_ns"], order["phase_ns"]
    with zenoh.open(config) as session:
        outgoing = [
            (
                session.declare_publisher(
                    key, congestion_control=zenoh.CongestionControl.DROP, express=True
                ).put,
                os.urandom(size),
                every,
            )
            for key, size, every in order["publish"]
        ]
        subscribers = [
            session.declare_subscriber(key, zenoh.handlers.RingChannel(INBOX_SIZE))
            for key in order["subscribe"]
        ]
        incoming = [subscriber.try_recv for subscriber in subscribers]
        token = session.liveliness().declare_token(order["alive"])
        gc.collect()
        gc.freeze()
        offset_ns = time.time_ns() - time.monotonic_ns()
        deadline_ns = (time.monotonic_ns() + offset_ns - phase_ns) // period_ns * period_ns + phase_ns
        tick = 0
        while not asked and (tick % 16 or os.getppid() == parent):
            tick += 1
            deadline_ns += period_ns
            remaining_ns = deadline_ns - offset_ns - time.monotonic_ns()
            if remaining_ns > 0:
                time.sleep(remaining_ns / 1e9)
            for receive in incoming:
                while (sample := receive()) is not None:
                    sample.payload.to_bytes()
            for put, payload, every in outgoing:
                if tick % every == 0:
                    put(payload)
        del token


if __name__ == "__main__":
    main()
