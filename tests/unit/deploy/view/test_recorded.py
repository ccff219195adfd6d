"""What the page asks of a recording it gets."""

from __future__ import annotations

import json

from handfast.deploy.playback.page import MODULES, served
from handfast.deploy.playback.scene import Track
from handfast.deploy.view.recorded import answers
from tests.unit.deploy.playback.runs import result_of


def test_the_page_its_files_and_the_run_are_there() -> None:
    result = result_of()
    track = Track(result)
    answer = answers(result)
    page = answer("")
    assert page is not None
    assert page.body == served("recorded")
    scene = answer("scene")
    assert scene is not None
    assert json.loads(scene.body)["track"]["rows"] == track.rows
    for path, body in (("overview", track.overview()), ("piece/0", track.piece(0))):
        found = answer(path)
        assert found is not None
        assert found.body == body
    for name in MODULES:
        script = answer(name)
        assert script is not None
        assert script.kind.startswith("text/javascript")


def test_there_is_nothing_else() -> None:
    answer = answers(result_of())
    for path in (
        "piece/1",
        "piece/-1",
        "piece/",
        "piece/x",
        "piece/²",
        f"piece/{'9' * 5000}",
        "index.html",
        "a/b",
    ):
        assert answer(path) is None
