"""Every state has a look, and the page knows each."""

from __future__ import annotations

from handfast.agent.supervision.state_machine import DRIVING_NAMES, State
from handfast.deploy.playback.looks import DRIVES, FAILED, LOOKS, RESTS, SILENT, TROUBLED, UNREADY
from handfast.deploy.playback.page import asset


def test_every_state_has_a_look() -> None:
    assert set(LOOKS) == {"", SILENT, *(state.value for state in State)}
    assert {LOOKS[name] for name in DRIVING_NAMES} == {DRIVES, TROUBLED}


def test_the_page_knows_each_look() -> None:
    text = b"".join(asset(name) or b"" for name in ("drawing.js", "panels.js")).decode()
    for look in (DRIVES, FAILED, RESTS, TROUBLED, UNREADY):
        assert look in text
