"""A simulated rover without its radio: body, estimate, modes, arming and failsafes of ArduPilot Rover (PURE).

It is stepped at the autopilot's loop rate; what it has to say waits in `texts`. Times are ns of the wall
clock.
"""

from __future__ import annotations

from math import cos, radians, sin
from typing import Final

from handfast.agent.common.random_streams import stream, uniform
from handfast.bridges.mavlink.ardupilot import constants
from handfast.bridges.mavlink.ardupilot.dynamics import Limits, RoverDynamics, limited
from handfast.bridges.mavlink.ardupilot.frames import Geodetic, local_to_geodetic
from handfast.bridges.mavlink.simulator.guided import Guided, Pose
from handfast.bridges.mavlink.simulator.navigation import Fence, Navigation, Reception
from handfast.bridges.mavlink.simulator.settings import Parameters, Settings

CREEP_M: Final = (0.03, 0.09)
"""m, least and most, that it creeps while it boots."""
CREEP_FROM: Final = 0.05
CREEP_UNTIL: Final = 0.55
"""Of the time to boot: while it creeps."""
WARM_BOOTS: Final = 1.5
"""A warm rover has been on for so many times its time to boot."""
WARM_STEP_S: Final = 0.1
EKF_CHECK_PERIOD_NS: Final = 100_000_000
EKF_CHECKS: Final = 10
"""So many checks of a lost position in a row are a failsafe."""
FENCE_PERIOD_NS: Final = 100_000_000
TURN_RADIUS: Final = 0.9
"""m (TURN_RADIUS). Steered by its front wheels it turns in no less, so not at all where it stands."""
PREARM_PERIOD_NS: Final = 30_000_000_000
"""How often a disarmed rover says why it cannot be armed."""
NEED_POSITION: Final = frozenset(
    {
        constants.MODE_LOITER,
        constants.MODE_FOLLOW,
        constants.MODE_DOCK,
        constants.MODE_CIRCLE,
        constants.MODE_AUTO,
        constants.MODE_RTL,
        constants.MODE_SMART_RTL,
        constants.MODE_GUIDED,
    }
)
NOT_ARMABLE: Final = frozenset({constants.MODE_RTL, constants.MODE_SMART_RTL, constants.MODE_INITIALISING})
ACTIONS: Final = {
    1: (constants.MODE_RTL, constants.MODE_HOLD),
    2: (constants.MODE_HOLD,),
    3: (constants.MODE_SMART_RTL, constants.MODE_RTL, constants.MODE_HOLD),
    4: (constants.MODE_SMART_RTL, constants.MODE_HOLD),
}
"""Modes that FS_ACTION, BATT_FS_*_ACT and FENCE_ACTION try, in this order."""
CRITICAL, WARNING, INFO = 2, 4, 6
"""MAV_SEVERITY."""


class Vehicle:
    """One rover from its first boot on.

    Attributes:
        truth: how it moves, NED about `settings.home`.
        navigation: what it believes of that.
        mode, armed: as in its heartbeat. `changed`: its mode is another than the last heartbeat said.
        crashed: why its process ended; empty while it lives.
        texts: severity and text of what it says, oldest first; whoever sends them empties it.
    """

    def __init__(self, settings: Settings, now_ns: int) -> None:
        self.settings = settings
        self.parameters = Parameters(settings)
        self.truth = RoverDynamics(0.0, 0.0, settings.yaw)
        self.crashed = ""
        self.texts: list[tuple[int, str]] = []
        self.boots = 0
        self._handed_over = not settings.hand_over
        warm_s = WARM_BOOTS * settings.boot_s if settings.boot == "warm" else 0.0
        self._boot(now_ns - round(warm_s * 1e9))
        steps = round(warm_s / WARM_STEP_S)
        for k in range(steps):
            self._believe(warm_s * (k + 1) / steps, warm_s / steps)
        self.texts.clear()

    def _boot(self, boot_ns: int) -> None:
        self.boots += 1
        settings, seed = self.settings, self.settings.seed
        self.boot_ns = boot_ns
        self.system = round(self.parameters["SYSID_THISMAV"])
        self.navigation = Navigation(settings.home, settings.boot_s, seed, self.system, self.boots)
        draws = stream("rover creep", seed, self.system, self.boots)
        least, most = CREEP_M
        self._creep = least + (most - least) * uniform(draws, 0)
        self.mode = constants.MODE_MANUAL
        self.armed = False
        self.changed = True
        self.guided = Guided()
        self.ground_station_ns: int | None = None
        self._ground_station_bad_ns: int | None = None
        self.failsafe = self.ekf_failsafe = False
        self._ekf_checks = 0
        self._ekf_check_ns = boot_ns
        self.fence = Fence()
        self._fence_ns = boot_ns
        self._battery_low_ns: int | None = None
        self._battery_acted = False
        self._prearm_ns = boot_ns

    def reboot(self, now_ns: int) -> None:
        """Off and on again where it stands. Parameters stay, all else is as after any boot."""
        self.truth = RoverDynamics(self.truth.north, self.truth.east, self.truth.yaw)
        self.texts.clear()
        self._boot(now_ns)

    @property
    def place(self) -> Geodetic:
        """Where it is in truth."""
        return local_to_geodetic(self.settings.home, self.truth.north, self.truth.east)

    @property
    def _from_home(self) -> tuple[float, float]:
        return self.truth.north, self.truth.east

    @property
    def pose(self) -> Pose:
        """Where it believes that it is, about its EKF origin."""
        return Pose(self.navigation.north, self.navigation.east, self.navigation.yaw)

    @property
    def takes_setpoints(self) -> bool:
        """GUIDED, with an EKF origin: only then is a setpoint even looked at."""
        return self.mode == constants.MODE_GUIDED and self.navigation.origin is not None

    def say(self, severity: int, text: str) -> None:
        """A STATUSTEXT."""
        self.texts.append((severity, text))

    def crash(self, why: str) -> None:
        """Its process ends: it says no more, and its motors stop."""
        self.crashed = why
        self.armed = False

    def set_mode(self, mode: int) -> bool:
        """Whether it is in `mode` now. An armed rover without a position refuses modes that need one."""
        if mode not in constants.MODE_NAMES or mode == constants.MODE_INITIALISING:
            return False
        if mode == self.mode:
            return True
        lost = not self.navigation.ready or self.ekf_failsafe
        # AUTO wants a mission, and this one never has any; DOCK wants a beacon, FOLLOW somebody to follow.
        if mode in {constants.MODE_AUTO, constants.MODE_DOCK, constants.MODE_FOLLOW} or (
            self.armed and lost and mode in NEED_POSITION
        ):
            self.say(WARNING, "Flight mode change failed")
            return False
        self.mode = mode
        self.changed = True
        self.guided.clear()
        return True

    def arming_refused(self) -> str:
        """Why it cannot be armed; empty where it can."""
        if not self.navigation.initialised:
            return "AHRS: EKF3 not started"
        if self.mode in NOT_ARMABLE:
            return "Mode not armable"
        if self.parameters["ARMING_CHECK"] == 0:
            return ""
        if self.navigation.fix < constants.GPS_3D_FIX:
            return "GPS 1: Bad fix"
        if not self.navigation.ready or self.ekf_failsafe:
            return "Need Position Estimate"
        return ""

    def arm(self, forced: bool = False) -> bool:
        """Whether it is armed now. Forced before its EKF is ready, it crashes as the autopilot can."""
        if self.armed:
            return True
        if forced:
            if not self.navigation.ready:
                self.crash("it was armed by force before its EKF was ready")
                return False
        elif why := self.arming_refused():
            self.say(CRITICAL, f"Arm: {why}")
            return False
        self.armed = True
        self.say(INFO, "Throttle armed")
        return True

    def disarm(self) -> None:
        """Motors off."""
        if self.armed:
            self.armed = False
            self.say(INFO, constants.DISARMED_TEXT)

    def step(self, now_ns: int, dt: float) -> None:
        """One loop: what happened in the last `dt` (s) up to `now_ns`."""
        if self.crashed:
            self.truth.step(dt, 0.0, 0.0, powered=False)
            return
        if not self._handed_over and not self.armed and not self.arming_refused():
            self._handed_over = self.set_mode(constants.MODE_GUIDED) and self.arm()
        self._look_at_failsafes(now_ns)
        parameters = self.parameters
        limits = Limits(
            parameters["WP_SPEED"],
            parameters["ATC_ACCEL_MAX"],
            radians(parameters["ATC_STR_RAT_MAX"]),
            parameters["ATC_TURN_MAX_G"],
        )
        speed = yaw_rate = 0.0
        if self.mode == constants.MODE_GUIDED:
            if self.guided.timed_out(now_ns, self.parameters["GUID_TIMEOUT"]):
                self.say(WARNING, constants.SETPOINT_TIMEOUT_TEXT)
            speed, yaw_rate = self.guided.demand(self.pose, limits.speed, parameters["WP_RADIUS"])
            speed = self.fence.slowed(parameters, speed, self.truth.yaw, self._from_home, now_ns)
        if not parameters.turns_on_the_spot:
            yaw_rate = limited(yaw_rate, abs(self.truth.speed) / TURN_RADIUS)
        self.truth.step(dt, speed, yaw_rate, powered=self.armed, limits=limits)
        self._believe((now_ns - self.boot_ns) * 1e-9, dt)

    def _believe(self, time: float, dt: float) -> None:
        boot_s = self.settings.boot_s
        if CREEP_FROM * boot_s < time <= CREEP_UNTIL * boot_s and not self.armed:
            way = self._creep * dt / ((CREEP_UNTIL - CREEP_FROM) * boot_s)
            self.truth.north += way * cos(self.truth.yaw)
            self.truth.east += way * sin(self.truth.yaw)
        off, jammed = self.parameters["SIM_GPS1_ENABLE"] == 0, self.parameters["SIM_GPS1_JAM"] != 0
        gps = Reception.OFF if off else Reception.JAMMED if jammed else Reception.GOOD
        had = self.navigation.origin
        self.navigation.step(time, dt, self.truth, gps, self.parameters["SIM_GPS1_LAG_MS"] * 1e-3)
        if self.navigation.origin is not None and had is None:
            self.say(INFO, "EKF3 IMU0 origin set")

    def _look_at_failsafes(self, now_ns: int) -> None:
        if now_ns - self._ekf_check_ns >= EKF_CHECK_PERIOD_NS:
            self._ekf_check_ns = now_ns
            self._look_at_ekf()
        self._look_at_ground_station(now_ns)
        self._look_at_battery(now_ns)
        if now_ns - self._fence_ns >= FENCE_PERIOD_NS:
            self._fence_ns = now_ns
            self._look_at_fence()
        if not self.armed and now_ns - self._prearm_ns >= PREARM_PERIOD_NS:
            self._prearm_ns = now_ns
            if why := self.arming_refused():
                self.say(CRITICAL, f"PreArm: {why}")

    def _look_at_ekf(self) -> None:
        parameters = self.parameters
        most, navigation = parameters["FS_EKF_THRESH"], self.navigation
        bad = not navigation.ready or navigation.variances.beyond(most)
        lost = self.armed and most > 0 and bad
        if lost:
            self._ekf_checks = min(EKF_CHECKS, self._ekf_checks + 1)
        else:
            self._ekf_checks = max(0, self._ekf_checks - 1) if self.armed else 0
        if lost and self._ekf_checks >= EKF_CHECKS and not self.ekf_failsafe:
            self.ekf_failsafe = True
            if self.mode in NEED_POSITION and parameters["FS_EKF_ACTION"] != 0:
                if parameters["FS_EKF_ACTION"] == 1:
                    self.set_mode(constants.MODE_HOLD)
                self.say(CRITICAL, "EKF failsafe")
        elif self.ekf_failsafe and self._ekf_checks == 0:
            self.ekf_failsafe = False
            self.say(CRITICAL, "EKF failsafe cleared")

    def _look_at_ground_station(self, now_ns: int) -> None:
        parameters = self.parameters
        seen_ns = self.ground_station_ns
        if parameters["FS_GCS_ENABLE"] == 0 or seen_ns is None:
            bad = False
        else:
            bad = now_ns - seen_ns > parameters["FS_GCS_TIMEOUT"] * 1e9
        if not bad:
            self._ground_station_bad_ns = None
            if self.failsafe:
                self.failsafe = False
                self.say(INFO, "GCS Failsafe Cleared")
            return
        if self._ground_station_bad_ns is None:
            self._ground_station_bad_ns = now_ns
        if (
            not self.failsafe
            and now_ns - self._ground_station_bad_ns > parameters["FS_TIMEOUT"] * 1e9
            and self.mode not in {constants.MODE_RTL, constants.MODE_HOLD}
        ):
            self.failsafe = True
            self.say(WARNING, "GCS Failsafe")
            self._act(round(parameters["FS_ACTION"]))

    def _look_at_battery(self, now_ns: int) -> None:
        parameters = self.parameters
        low = parameters["BATT_LOW_VOLT"]
        if not (self.armed and 0.0 < parameters["SIM_BATT_VOLTAGE"] < low):
            self._battery_low_ns = None
            return
        if self._battery_low_ns is None:
            self._battery_low_ns = now_ns
        if not self._battery_acted and now_ns - self._battery_low_ns > parameters["BATT_LOW_TIMER"] * 1e9:
            self._battery_acted = True
            self.say(WARNING, f"Battery 1 is low {parameters['SIM_BATT_VOLTAGE']:.2f}V used 0 mAh")
            self._act(round(parameters["BATT_FS_LOW_ACT"]))

    def _look_at_fence(self) -> None:
        if self.fence.look(self.parameters, *self._from_home) and self.armed:
            self._act(round(self.parameters["FENCE_ACTION"]))

    def _act(self, action: int) -> None:
        """What a failsafe does."""
        for mode in ACTIONS.get(action, ()):
            if self.set_mode(mode):
                return
