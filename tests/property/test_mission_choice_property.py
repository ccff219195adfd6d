"""Whatever missions come in whatever order: all who take them end with the same one."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from handfast.agent.core import Agent
from handfast.agent.fleet.loading import digest
from handfast.agent.formation.geometry import resolve
from handfast.agent.messages.codec import encode
from handfast.agent.messages.sequence_numbers import SequenceNumbers
from handfast.agent.messages.types import Left, Mission, Removed
from handfast.deploy.orders.operator import Known
from handfast.deploy.recording.collector import RunData
from handfast.plant.node import PlantNode
from tests.unit.deploy.orders.order_fleets import EPOCH, S, square
from tests.unit.plant.test_node import Backend

FLEET = square()
GEOMETRY = resolve(FLEET)
KEY = "square/mission"
HELD = (("kind", "hold"), ("start_m", (1.0, 2.0)))
MISSIONS = st.builds(
    Mission,
    version=st.integers(1, 3),
    time_ns=st.just(EPOCH),
    epoch_ns=st.sampled_from([EPOCH, EPOCH + S, EPOCH - 3 * S]),
    duration_ns=st.sampled_from([60 * S, 61 * S]),
    digest=st.just(digest(FLEET)),
    trajectory=st.sampled_from([(), HELD, (("kind", "nowhere"),)]),  # the last cannot be driven
    from_ns=st.sampled_from([0, EPOCH + 2 * S]),
    blend_ns=st.just(S),
    note=st.just(""),
    trajectory_ns=st.just(0),
    edges=st.just(()),
    robots=st.sampled_from([(), ((1, 0.0, 0.0), (2, 3.0, 0.0)), ((99, 0.0, 0.0),)]),
    removed=st.sampled_from([(), (Removed(1, EPOCH),)]),
    left=st.sampled_from([(), (Left(0.5, 0.0, 0.1, 0.0, 1.0, 0.0, 0.1, 0.0, 2.0, 0.3, 1.0),)]),
)


def drivable(mission: Mission) -> bool:
    return mission.trajectory != (("kind", "nowhere"),) and mission.robots != ((99, 0.0, 0.0),)


class Everybody:
    """One of each who takes missions: agent, plant, operator, recording."""

    def __init__(self) -> None:
        self.agent = Agent(FLEET, 2)
        self.plant = PlantNode(FLEET, 2, Backend())
        self.known = Known(FLEET, GEOMETRY)
        self.data = RunData(FLEET)

    def hear(self, mission: Mission) -> None:
        for node in (self.agent, self.plant):
            node.receive(EPOCH, KEY, encode(mission))
        self.known.hear(KEY, mission)
        self.data.feed(EPOCH, KEY, mission)

    def held(self) -> list[Mission | None]:
        agent = self.agent
        reference = agent._controller.reference.plan
        return [
            agent._situation.mission,
            None if reference is None else reference.mission,
            self.plant._missions.mission,
            self.known.mission,
            self.data.recording().mission,
        ]

    def epochs(self) -> set[int]:
        """By which the agent and its plant number what they send, as others see it."""
        numbers = SequenceNumbers(FLEET.period_ns)
        numbers.begin(self.plant._epoch_ns)
        assert self.plant._numbers.at(EPOCH + 9 * S) == numbers.at(EPOCH + 9 * S)
        mission = self.agent._situation.mission
        assert mission is not None
        return {self.plant._epoch_ns, mission.epoch_ns, self.data.recording().epoch_ns or 0}


@given(st.lists(MISSIONS, min_size=1, max_size=5), st.randoms(use_true_random=False))
@settings(max_examples=30, deadline=None)
def test_any_order_of_any_missions_ends_with_all_on_the_same(missions: list[Mission], order):  # type: ignore[no-untyped-def]
    one, other = Everybody(), Everybody()
    for mission in missions:
        one.hear(mission)
    shuffled = [*missions, missions[0]]
    order.shuffle(shuffled)
    for mission in shuffled:
        other.hear(mission)
    held = [*one.held(), *other.held()]
    assert all(each == held[0] for each in held), held
    assert (held[0] is not None) == any(map(drivable, missions))
    if held[0] is not None:
        assert one.epochs() == other.epochs() == {held[0].epoch_ns}
        assert held[0].version == max(mission.version for mission in missions if drivable(mission))
