"""What a bridge and its vehicle say in a second, and what share of a serial line that is."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from tests.process.harness import measured
from tests.rover_scene import Scene

SECONDS = 10.0
SETTLED_S = 15.0
BYTE_BITS = 10


def bytes_a_second(state_rate_hz: float) -> tuple[float, float]:
    """From the vehicle and to it, while it drives by 20 setpoints a second."""
    scene = Scene(f"robot_defaults.mavlink.state_rate_hz={state_rate_hz}")
    scene.run(SETTLED_S)  # parameters have been read, rates asked for
    scene.drive()
    port = scene.bridge.port
    receive: Callable[[], list[tuple[int, bytes]]] = port.receive
    came = 0

    def counted() -> list[tuple[int, bytes]]:
        nonlocal came
        pieces = receive()
        came += sum(len(data) for _, data in pieces)
        return pieces

    port.receive = counted  # type: ignore[method-assign]
    before = len(port.sent)
    scene.run(SECONDS)
    return came / SECONDS, sum(len(data) for _, data in port.sent[before:]) / SECONDS


@pytest.mark.parametrize(("state_rate_hz", "down", "up"), [(25.0, 2090.0, 1440.0), (10.0, 1130.0, 1440.0)])
def test_the_shares_that_the_docs_state(state_rate_hz: float, down: float, up: float) -> None:
    found = bytes_a_second(state_rate_hz)
    for way, count in zip(("down", "up"), found, strict=True):
        measured(f"bytes a second {way}, state at {state_rate_hz:g} Hz", count)
        for baud in (57_600, 921_600):
            measured(f"  per cent of {baud} baud", 100.0 * count * BYTE_BITS / baud)
    assert found == pytest.approx((down, up), rel=0.03)
