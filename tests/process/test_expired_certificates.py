"""Robots that start with a certificate that is not valid now: they wait, and take their places once it is."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Final

import pytest

from handfast.agent.runtime.certificate_wait import WAITS
from handfast.agent.security.identity import of_robot
from tests.process.fleet_harness import placed
from tests.process.harness import no_trouble_in_logs
from tests.process.secured_fleet import AGO_S, Keys, SecuredRobots, three

pytestmark = pytest.mark.long

LATE: Final = 3
ROLES: Final = ("agent", "plant", "recorder")


def test_an_expired_one_is_looked_at_again_until_it_is_renewed(tmp_path: Path) -> None:
    with ExitStack() as stack:
        fleet = stack.enter_context(placed(three("fleet.rate_hz=25")))
        at = stack.enter_context(Keys(fleet, tmp_path / "keys"))
        at.give(of_robot(at.name, LATE), at.now_s - AGO_S)
        robots = stack.enter_context(SecuredRobots(fleet, tmp_path / "r", at))
        robots.start_all()
        robots.run(
            *(
                LATE,
                "recorder",
                "handfast.agent.recorder",
                "--fleet",
                str(robots.fleet_file),
                "--robot",
                str(LATE),
            ),
            *("--keys", str(at.of(of_robot(at.name, LATE))), "--folder", str(tmp_path / "recording")),
        )
        for role in ROLES:
            robots.wait(lambda role=role: WAITS in robots.log_of(LATE, role), f"the {role} waits")
        assert not robots.died(), robots.told()
        assert not any(robots.alive(LATE, role) for role in ("agent", "plant"))
        at.give(of_robot(at.name, LATE), at.now_s)
        robots.wait_until_all("ready")
        robots.wait(lambda: "recording into" in robots.log_of(LATE, "recorder"), "it is recorded")
        for role in ROLES:
            assert robots.log_of(LATE, role).count(WAITS) == 1, "once a minute"
        assert not robots.died(), robots.told()
        no_trouble_in_logs(robots.folder)
