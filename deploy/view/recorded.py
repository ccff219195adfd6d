"""A recording as the page asks for it."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Final

from deploy.playback.page import asset, served
from deploy.playback.scene import scene
from deploy.playback.track import Track
from deploy.verdict.run_result import RunResult
from deploy.view.server import Content

_PIECE: Final = "piece/"
_KINDS: Final = {"js": "text/javascript; charset=utf-8", "css": "text/css; charset=utf-8"}
_ROWS: Final = "application/octet-stream"


def answers(result: RunResult) -> Callable[[str], Content | None]:
    """What a server of this run answers: the page and its files, `scene` (JSON), `overview` and ``piece/K``
    (rows, `deploy.playback.track`).

    Raises:
        agent.formation.geometry.FormationError: the run's formation cannot be resolved.
    """
    track = Track(result)
    description = Content(
        json.dumps(scene(result, track), allow_nan=False).encode(), "application/json; charset=utf-8"
    )
    overview = Content(track.overview(), _ROWS)
    page = Content(served(), "text/html; charset=utf-8")

    def answer(path: str) -> Content | None:
        if path == "":
            return page
        if path == "scene":
            return description
        if path == "overview":
            return overview
        if path.startswith(_PIECE):
            number = path.removeprefix(_PIECE)
            is_there = number.isascii() and number.isdecimal() and len(number) < 10
            return (
                Content(track.piece(int(number)), _ROWS) if is_there and int(number) < track.pieces else None
            )
        found = asset(path)
        return None if found is None else Content(found, _KINDS[path.rpartition(".")[2]])

    return answer
