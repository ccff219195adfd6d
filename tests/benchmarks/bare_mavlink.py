"""A bare pymavlink program: decodes what a vehicle sends, and does nothing with it.

The yardstick of `bridge.py`. What it is to do comes as one JSON object::

    {"host": name, "port": n, "how": "mavutil" | "parser", "intervals": [[message id, us], ...]}

"mavutil" reads as pymavlink's users do (`recv_match(blocking=True)`), "parser" gives each datagram of a
blocking socket to `MAVLink.parse_buffer`: the cheapest use of its decoding. SIGUSR1 makes it print how many
messages it has decoded.
"""

import gc
import json
import os
import signal
import socket
import sys

os.environ["MAVLINK20"] = "1"
from typing import Any

from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as dialect

AUTOPILOT = 1


def request(system: int, message: int, interval_us: int) -> dialect.MAVLink_message:
    command = dialect.MAV_CMD_SET_MESSAGE_INTERVAL
    values = (float(message), float(interval_us), 0.0, 0.0, 0.0, 0.0, 0.0)
    return dialect.MAVLink_command_long_message(system, AUTOPILOT, command, 0, *values)


def by_mavutil(order: dict[str, Any]) -> None:
    vehicle = mavutil.mavlink_connection(f"udpin:{order['host']}:{order['port']}")
    heartbeat = vehicle.wait_heartbeat()
    for message, interval_us in order["intervals"]:
        vehicle.mav.send(request(heartbeat.get_srcSystem(), message, interval_us))
    ready(vehicle.mav)
    while True:
        vehicle.recv_match(blocking=True)


def by_parser(order: dict[str, Any]) -> None:
    udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    udp.bind((order["host"], order["port"]))
    mav = dialect.MAVLink(None, 255, 0)
    mav.robust_parsing = True
    system = None
    while system is None:
        data, vehicle = udp.recvfrom(65_536)
        for message in mav.parse_buffer(data) or ():
            if message.get_type() == "HEARTBEAT":
                system = message.get_srcSystem()
    for message, interval_us in order["intervals"]:
        udp.sendto(request(system, message, interval_us).pack(mav), vehicle)
        mav.seq += 1
    ready(mav)
    while True:
        mav.parse_buffer(udp.recv(65_536))


def ready(mav: dialect.MAVLink) -> None:
    signal.signal(signal.SIGUSR1, lambda *_: print(mav.total_packets_received, flush=True))
    gc.collect()
    gc.freeze()


def main() -> None:
    order = json.loads(sys.argv[1])
    {"mavutil": by_mavutil, "parser": by_parser}[order["how"]](order)


if __name__ == "__main__":
    main()
