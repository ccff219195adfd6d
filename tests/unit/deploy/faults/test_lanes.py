"""A lane for each rule of a run, with its times."""

from __future__ import annotations

from handfast.deploy.faults.lanes import lanes
from handfast.deploy.recording.collector import RunData
from handfast.deploy.recording.recording import Recording
from tests.unit.deploy.simulated_run import driven, trio


def recorded(faults: str) -> Recording:
    fleet = trio(faults)
    data = RunData(fleet)
    for sent in driven(fleet):
        data.feed(*sent)
    return data.recording()


def test_every_rule_has_a_lane_and_what_holds_everywhere_comes_first() -> None:
    many = "".join(
        f'[[faults.rule]]\nname = "r{k}"\nlink = "1->2"\nloss = "9%"\nat = {k / 10}\nfor = 0.05\n'
        for k in range(12)
    )
    found = lanes(recorded('[faults]\ndelay = "1ms"\n' + many), 2.0)
    assert [lane.text for lane in found] == [
        "[faults]: delay 1ms on every link",
        *(f"r{k}: loss 9% on 1->2" for k in range(12)),
    ]
    assert found[0].times == [(0.0, 2.0)]
    assert found[1].times == [(0.0, 0.05)]


def test_a_run_without_faults_has_no_lane() -> None:
    assert lanes(recorded(""), 2.0) == []
