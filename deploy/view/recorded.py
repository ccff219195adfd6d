"""The page of a recorded run, as its server answers for it."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Final

from handfast.deploy.playback.scene import Track, scene
from handfast.deploy.verdict.run_result import RunResult
from handfast.deploy.view.server import Content, page_files

_PIECE: Final = "piece/"
_ROWS: Final = "application/octet-stream"


def answers(result: RunResult) -> Callable[[str], Content | None]:
    """What a server of this run answers: the page and its files, `scene` (JSON), `overview` and ``piece/K``
    (rows, `deploy.playback.track`).

    Raises:
        handfast.agent.formation.geometry.FormationError: the run's formation cannot be resolved.
    """
    track = Track(result)
    description = Content(
        json.dumps(scene(result, track), allow_nan=False).encode(), "application/json; charset=utf-8"
    )
    overview = Content(track.overview(), _ROWS)
    files = page_files("recorded")

    def answer(path: str) -> Content | None:
        if path == "scene":
            return description
        if path == "overview":
            return overview
        if not path.startswith(_PIECE):
            return files(path)
        number = path.removeprefix(_PIECE)
        is_there = number.isascii() and number.isdecimal() and len(number) < 10
        return Content(track.piece(int(number)), _ROWS) if is_there and int(number) < track.pieces else None

    return answer
