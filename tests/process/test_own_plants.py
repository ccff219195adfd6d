"""Plants of one's own from a package of their own: in `simulate`, `run` and `sweep`; each mistake's line."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from handfast.deploy.recording.mcap_reader import read_run
from tests.process.examples import installed
from tests.process.harness import BUSY, no_trouble_in_logs
from tests.process.test_own_laws import handfast, metrics, rows

NETWORK = ("--set", "network.base_port=21760")
DRAG = "--set robot_defaults.plant=drag --no-report --out out"
MISTAKES = """
import time
from math import nan

from handfast import Plant, Pose, Reading


class Good(Plant):
    steps = 0

    def step(self, now_ns, command):
        self.steps += 1
        if self.steps > 150:
            return self.later(now_ns)
        return self.reading(now_ns)

    def reading(self, now_ns):
        return Reading(now_ns, Pose(*self.setup.start, 0.0, 0.0), 0.0, 0.0)


class Raises(Good):
    def later(self, now_ns):
        raise ValueError("out of\\nits range")


class Nan(Good):
    def later(self, now_ns):
        return Reading(now_ns, Pose(0.0, nan, 0.0, 0.0, 0.0), 0.0, 0.0)


class Nothing(Good):
    def later(self, now_ns):
        return None


class Slow(Good):
    def later(self, now_ns):
        time.sleep(0.03)
        return self.reading(now_ns)


class Signature(Plant):
    def step(self, now_ns):
        return 1


class Constructor(Good):
    def __init__(self, setup):
        raise RuntimeError("no licence")


class Made(Good):
    def __init__(self, robot, start):
        pass


class Section(Good):
    section = "drag"


class NoPlant:
    pass
"""


@pytest.fixture(scope="module", autouse=True)
def _examples(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    folder = tmp_path_factory.mktemp("site")
    (folder / "mistakes.py").write_text(MISTAKES)
    with installed(folder), pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        yield


def test_in_simulate_they_form_up_and_slip(tmp_path: Path) -> None:
    handfast(tmp_path, f"simulate delta {DRAG} --duration 40s --set robot_defaults.drag.slip=0.05")
    found = metrics(tmp_path / "out")
    assert found["verdict"]["passed"], found["verdict"]
    text = (tmp_path / "out" / "fleet.toml").read_text()
    assert 'plant = "handfast_examples.drag_plant:Drag"' in text, "as any computer can read it"
    assert "slip = 0.05" in text
    assert read_run(tmp_path / "out").fleet.robot(1).kind.is_plugin, "the recording reads it back"


@pytest.mark.alone  # its verdict is on six robots, not on what else a machine has to do
def test_in_run_each_is_a_process_and_stands_where_it_was_after_a_restart(tmp_path: Path) -> None:
    (tmp_path / "restart.toml").write_text(
        '[[faults.rule]]\nname = "again"\nrobot = 2\nrestart = "plant"\nat = 4\n'
    )
    arguments = f"run delta {DRAG} --duration 30s --faults restart.toml"
    handfast(tmp_path, arguments, "--set", "robot_defaults.drag.drag=1", *BUSY, *NETWORK)
    found = metrics(tmp_path / "out")
    assert (found["mode"], found["verdict"]["passed"]) == ("run", True), found["verdict"]
    body = read_run(tmp_path / "out").robots[2].body
    steps = abs(body["x"][1:] - body["x"][:-1])
    assert float(steps.max()) < 0.5, "nowhere did it jump"
    no_trouble_in_logs(tmp_path / "out")


@pytest.mark.long
def test_a_sweep_varies_its_settings_and_the_plant(tmp_path: Path) -> None:
    drag = "sweep delta --set robot_defaults.plant=drag --duration 2s --jobs 2"
    handfast(tmp_path, f"{drag} --over robot_defaults.drag.drag=0,20 --out drags")
    assert len({row["rms_distance_error_m"] for row in rows(tmp_path / "drags")}) == 2
    handfast(
        tmp_path, "sweep delta --over robot_defaults.plant=unicycle,drag --duration 2s --jobs 2 --out kinds"
    )
    assert len({row["rms_distance_error_m"] for row in rows(tmp_path / "kinds")}) == 2


BEFORE = {
    "Constructor": "plant mistakes:Constructor: cannot be made: RuntimeError: no licence (mistakes.py:",
    "Made": "plant mistakes:Made: cannot be made: TypeError: Made.__init__() missing 1 required positional",
    "Signature": "plant mistakes:Signature: step failed with TypeError: Signature.step() takes 2 positional",
    "Section": "mistakes:Section: Settings must be a class below @dataclass(frozen=True)",
    "NoPlant": "mistakes:NoPlant: is no subclass of Plant: write class NoPlant(Plant), with from handfast",
    "Nowhere": "mistakes:Nowhere: there is no Nowhere in mistakes;",
}
"""What is said of each mistake before anything drives."""


@pytest.mark.long
@pytest.mark.parametrize(("command", "status"), [("simulate", 2), ("run", 1)])
def test_unchecked_the_start_is_refused_with_the_same_line(command: str, status: int, tmp_path: Path) -> None:
    arguments = f"{command} pair --no-check --no-report --duration 2s --out out --set robot.1.plant=mistakes:"
    said = handfast(tmp_path, f"{arguments}Constructor", *NETWORK, status=status)
    assert BEFORE["Constructor"] in said


LATER = {
    "Raises": "step failed with ValueError: out of (mistakes.py:23)",
    "Nan": "step returned a Reading whose y is nan",
    "Nothing": "step returned NoneType, not a Reading: Reading(now_ns, Pose(...), force, torque)",
}


@pytest.mark.long
@pytest.mark.parametrize("command", ["simulate", "run"])
@pytest.mark.parametrize("plant", LATER)
def test_one_that_fails_in_mid_drive_is_one_fault_of_one_robot(
    command: str, plant: str, tmp_path: Path
) -> None:
    arguments = f"{command} pair --set robot.1.plant=mistakes:{plant} --no-report --duration 3s --out out"
    said = handfast(tmp_path, arguments, *NETWORK, status=1)
    line = f"plant mistakes:{plant}: {LATER[plant]}"
    assert said.count(f"robot 1 is in fault: plant unhealthy: {line}") == 1, said
    (reason,) = [text for text in metrics(tmp_path / "out")["verdict"]["reasons"] if line in text]
    assert reason.startswith("Robot 1 ended the drive in state fault")
    for log in (tmp_path / "out").rglob("robot-1-plant.log"):
        assert log.read_text().count(line) == 1, "said once"
