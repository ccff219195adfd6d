"""Whom a MAVLink session speaks to, and as whom."""

from __future__ import annotations

from dataclasses import dataclass

from handfast.agent.fleet.mavlink_section import MavlinkSection
from handfast.bridges.mavlink.ardupilot import constants
from handfast.bridges.mavlink.ardupilot.frames import Geodetic
from handfast.bridges.mavlink.session.parameters import AUDITED
from handfast.bridges.mavlink.session.signing import Signing


@dataclass(frozen=True)
class SessionSettings:
    """Whom to speak to, and as whom.

    Attributes:
        system: the vehicle's id; None: the first autopilot that is heard.
        component: the own one. The own system is the vehicle's.
        state_rate_hz: of ATTITUDE and LOCAL_POSITION_NED.
        datum: offered as the EKF's origin; None: nothing is offered.
        signing: the key that both sides sign with; None: unsigned, and signatures are not looked at.
        token: tells the own heartbeats (`custom_mode`) and questions for the time from those of a bridge that
            speaks as the same system and component. Random; 0: none.
        parameters: names of those to read.

    Raises:
        ValueError: an identity that is another's.
    """

    system: int | None = None
    component: int = constants.COMPONENT_ONBOARD_COMPUTER
    state_rate_hz: float = 25.0
    datum: Geodetic | None = None
    signing: Signing | None = None
    token: int = 0
    parameters: tuple[str, ...] = AUDITED

    def __post_init__(self) -> None:
        if self.system is not None and not 1 <= self.system < constants.SYSTEM_GROUND_STATION:
            raise ValueError(f"system must be from 1 to 254 (255 is the ground station's), not {self.system}")
        if not 2 <= self.component <= 254:
            raise ValueError(f"component must be from 2 to 254 (1 is the autopilot's), not {self.component}")
        if not 1.0 <= self.state_rate_hz <= 1000.0:
            raise ValueError(f"state_rate_hz must be from 1 to 1000, not {self.state_rate_hz}")
        if not 0 <= self.token < 2**32:
            raise ValueError(f"token must be from 0 to 2^32 - 1, not {self.token}")


def session_settings(
    section: MavlinkSection,
    token: int,
    *,
    signing: Signing | None = None,
    datum: Geodetic | None = None,
    parameters: tuple[str, ...] = (),
) -> SessionSettings:
    """Whom to speak to, and as whom, as a robot's section of the fleet file has it.

    Args:
        token, signing, parameters: as `SessionSettings` has them.
        datum: offered as the EKF's origin; None: nothing is offered.

    Raises:
        ValueError: an identity that is another's.
    """
    return SessionSettings(
        system=section.system,
        state_rate_hz=section.state_rate_hz,
        datum=datum,
        signing=signing,
        token=token,
        parameters=parameters,
    )
