"""What has to be kept of orders, and what is acknowledged of them when."""

from __future__ import annotations

from handfast.agent.messages.codec import decode
from handfast.agent.messages.types import Mission, Resume, Stop
from handfast.agent.supervision.orders import LastingOrders, StopLatch

MISSION = Mission(7, 0, 5, 10, "digest")


def made() -> tuple[LastingOrders, StopLatch]:
    latch = StopLatch(1, lambda: None)
    return LastingOrders(latch), latch


def test_without_a_disk_all_is_acknowledged_as_soon_as_it_is_known() -> None:
    lasting, latch = made()
    lasting.look(None)
    assert (lasting.current, lasting.acknowledged) == ((), (0, 0))
    latch.accept_stop(Stop(3, 0, "lunch"))
    lasting.look(MISSION)
    assert lasting.acknowledged == (7, 3)
    assert [decode(order) for order in lasting.current] == [Stop(3, 0, "lunch"), MISSION]


def test_with_a_disk_it_is_acknowledged_when_it_is_kept() -> None:
    lasting, latch = made()
    lasting.has_disk()
    latch.accept_stop(Stop(3, 0, ""))
    lasting.look(MISSION)
    first = lasting.current
    assert lasting.acknowledged == (0, 0)
    latch.accept_resume(Resume(4, 0, ()))
    lasting.look(MISSION)
    lasting.kept(first, "")  # the disk was slow: what was to be kept is another by now
    assert lasting.acknowledged == (0, 0)
    lasting.kept(lasting.current, "")
    assert lasting.acknowledged == (7, 4)


def test_what_cannot_be_kept_is_acknowledged_and_said() -> None:
    lasting, latch = made()
    lasting.has_disk()
    latch.accept_stop(Stop(3, 0, ""))
    lasting.look(None)
    lasting.kept(lasting.current, "not on its disk: no space left on device")
    assert lasting.acknowledged == (0, 3)
    assert lasting.trouble == "not on its disk: no space left on device"


def test_another_object_only_when_something_has_changed() -> None:
    lasting, latch = made()
    latch.accept_stop(Stop(3, 0, ""))
    lasting.look(MISSION)
    before = lasting.current
    latch.accept_stop(Stop(3, 0, ""))
    latch.accept_stop(Stop(2, 0, ""))
    lasting.look(MISSION)
    assert lasting.current is before
