"""A scene is JSON that describes its track and its fleet."""

from __future__ import annotations

import json

from handfast.deploy.playback.page import asset
from handfast.deploy.playback.scene import COLUMNS, FORMAT, Track, ground, scene
from handfast.deploy.recording.collector import RunData
from handfast.deploy.verdict.run_result import RunResult
from tests.unit.deploy.playback.runs import FLEET, result_of
from tests.unit.deploy.simulated_run import driven, trio

GROUND = """
[[obstacle]]
name = "shed"
points_m = [[5.0, 5.0], [6.0, 5.0], [6.0, 6.0]]
[[obstacle]]
centre_m = [9.0, 1.0]
radius_m = 0.4
[geofence]
points_m = [[-10.0, -10.0], [30.0, -10.0], [30.0, 30.0], [-10.0, 30.0]]
"""


def test_a_scene_is_json_and_fits_its_track() -> None:
    result = result_of()
    track = Track(result)
    found = scene(result, track)
    assert json.loads(json.dumps(found, allow_nan=False)) is not None
    assert found["format"] == FORMAT
    assert len(track.overview()) % (found["track"]["width"] * 4) == 0
    assert found["track"]["rows"] == len(result.analysis.grid)
    assert [each["id"] for each in found["robots"]] == list(FLEET.ids)
    assert len(found["edges"]) == found["track"]["width"] - len(FLEET.robots) * len(found["columns"])
    assert found["verdict"] == {"passed": True, "reasons": [], "warnings": []}
    assert found["states"][0][0][1:] == ["running", ""]


def test_the_ground_is_in_it() -> None:
    fleet = trio(GROUND)
    data = RunData(fleet)
    for sent in driven(fleet):
        data.feed(*sent)
    result = RunResult(data.recording())
    found = json.loads(json.dumps(scene(result, Track(result))))
    assert found["obstacles"] == [
        {"name": "shed", "points": [[5, 5], [6, 5], [6, 6]]},
        {"name": "obstacle 2", "x": 9, "y": 1, "radius": 0.4},
    ]
    assert len(found["fence"]) == 4


def test_what_is_known_before_a_drive_is_in_the_scene_of_its_run() -> None:
    """So a page shows both alike."""
    found = json.loads(json.dumps(ground(FLEET), allow_nan=False))
    assert found["safe_m"] == FLEET.formation.safe_distance_m
    assert found["columns"] == list(COLUMNS)
    assert found["fence"] is None
    result = result_of()
    of_run = json.loads(json.dumps(scene(result, Track(result))))
    assert {name: of_run[name] for name in found} == found


def test_the_page_knows_the_format() -> None:
    script = asset("main.js")
    assert script is not None
    assert f"const FORMAT = {FORMAT};" in script.decode()
