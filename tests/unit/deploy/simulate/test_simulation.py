"""A fleet in virtual time; what it does is in tests/simulation."""

from __future__ import annotations

from handfast.agent.common.time import NS_PER_S
from handfast.agent.fleet.loading import load_fleet
from handfast.agent.formation.geometry import resolved
from handfast.agent.messages.codec import decode
from handfast.agent.messages.types import PlantState
from handfast.deploy.console.data_files import FLEETS
from handfast.deploy.simulate.simulation import Simulation

PAIR = resolved(load_fleet(FLEETS / "pair.toml", ["fleet.duration_s=2"]))


def poses(begin_ns: int) -> tuple[int, list[tuple[int, float, float]]]:
    """The epoch of a drive, and poses by fleet time (ns)."""
    found = []

    def sink(_: int, key: str, payload: bytes) -> None:
        message = decode(payload)
        if type(message) is PlantState:
            found.append((message.time_ns, message.x, message.y))

    simulation = Simulation(PAIR, sink, begin_ns)
    simulation.run()
    epoch_ns = simulation.epoch_ns
    return epoch_ns, [(time_ns - epoch_ns, x, y) for time_ns, x, y in found]


def test_it_begins_when_it_is_told_and_drives_the_same_way() -> None:
    late_ns = 1_700_000_000 * NS_PER_S + 1
    early, late = poses(0), poses(late_ns)
    assert late_ns <= late[0] < late_ns + 2 * NS_PER_S
    assert early[0] < 2 * NS_PER_S
    assert [each for each in early[1] if each[0] >= 0] == [each for each in late[1] if each[0] >= 0]


def test_a_message_is_read_once_for_its_robots_and_whoever_takes_it_from_the_sink() -> None:
    came: list[bytes] = []
    simulation = Simulation(PAIR, lambda _, key, payload: came.append(payload))
    simulation.run()
    latest = [payload for payload in came if type(decode(payload)) is PlantState][-4:]
    heard = {id(agent._situation.plant) for agent in simulation.agents}
    assert heard <= {id(simulation.decode(each)) for each in latest}
    assert [simulation.decode(each) for each in latest] == [decode(each) for each in latest]
