"""A run in virtual time of which only what it is judged by is kept: for many runs."""

from __future__ import annotations

from handfast.agent.fleet.model import Fleet
from handfast.agent.messages import key_expressions
from handfast.deploy.recording.collector import RunData
from handfast.deploy.recording.recording import Recording
from handfast.deploy.simulate.simulation import Simulation
from handfast.deploy.simulate.worker_pool import Abandoned, GoOn


def drive(fleet: Fleet, go_on: GoOn = lambda: True) -> Recording:
    """Drives `fleet` (resolved) for its duration. What went wrong in the operator's eyes is in `reasons`.

    Raises:
        Abandoned: `go_on`, which is asked a few times for each second of fleet time, said no.
    """
    name = fleet.fleet.name
    data = RunData(fleet, mode="simulate")
    # Hand states, beacons and what agents did to them are most of the messages, and nobody is judged by them.
    wanted = {
        key_expressions.mission(name),
        key_expressions.stop(name),
        key_expressions.resume(name),
        key_expressions.events(name),
    }
    for robot in fleet.ids:
        wanted |= {
            key_expressions.plant_state(name, robot),
            key_expressions.plant_truth(name, robot),
            key_expressions.plant_links(name, robot),
            key_expressions.wrench(name, robot),
            key_expressions.status(name, robot),
            key_expressions.relayed(name, robot),
        }

    def sink(received_ns: int, key: str, payload: bytes) -> None:
        if key in wanted:
            data.feed(received_ns, key, simulation.decode(payload))

    def progress(_: float) -> bool:
        if not go_on():
            raise Abandoned
        return True

    simulation = Simulation(fleet, sink)
    simulation.run(progress)
    return data.recording(reasons=simulation.reasons)
