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
        own_system: own id; None: the vehicle's. `own_component` likewise the own one.
        state_rate_hz: of ATTITUDE and LOCAL_POSITION_NED.
        set_origin: whether to offer `datum` as the EKF's origin; without a datum nothing is offered.
        signing: the key that both sides sign with; None: unsigned, and signatures are not looked at.
        token: tells the own heartbeats (`custom_mode`) and questions for the time from those of a bridge that
            speaks as the same system and component. Random; 0: none.
        parameters: names of those to read.

    Raises:
        ValueError: an identity that is another's.
    """

    system: int | None = None
    own_system: int | None = None
    own_component: int = constants.COMPONENT_ONBOARD_COMPUTER
    state_rate_hz: float = 25.0
    set_origin: bool = True
    datum: Geodetic | None = None
    signing: Signing | None = None
    token: int = 0
    parameters: tuple[str, ...] = AUDITED

    def __post_init__(self) -> None:
        for name, system in (("system", self.system), ("own_system", self.own_system)):
            if system is not None and not 1 <= system < constants.SYSTEM_GROUND_STATION:
                raise ValueError(f"{name} must be from 1 to 254 (255 is the ground station's), not {system}")
        if not 2 <= self.own_component <= 254:
            raise ValueError(
                f"own_component must be from 2 to 254 (1 is the autopilot's), not {self.own_component}"
            )
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
        datum: offered as the EKF's origin, if the section allows that; None: nothing is offered.

    Raises:
        ValueError: an identity that is another's.
    """
    return SessionSettings(
        system=section.system,
        own_system=section.own_system,
        own_component=section.own_component,
        state_rate_hz=section.state_rate_hz,
        set_origin=section.set_origin and datum is not None,
        datum=datum,
        signing=signing,
        token=token,
        parameters=parameters,
    )
