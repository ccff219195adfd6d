"""A body on soft ground: drag slows it, and in turns it slips outwards."""

from dataclasses import dataclass
from math import cos, sin

from handfast import Command, Plant, Pose, Reading, Setup, setting


@dataclass(frozen=True)
class Settings:
    """How the ground holds a body."""

    drag: float = setting(4.0, "Drag of the ground, d.", unit="kg/s", ge=0, le=20)
    slip: float = setting(0.02, "Speed outwards over speed times yaw rate, s.", unit="s", ge=0, lt=1)


class Drag(Plant):
    """m v' = F - d v,  J w' = tau - d L^2 w,  and it slips sideways with -s v w."""

    section = "drag"
    Settings = Settings

    def __init__(self, setup: Setup) -> None:
        super().__init__(setup)
        self.pose = Pose(*setup.start, speed=0.0, yaw_rate=0.0)
        self.asked = Command(0.0, 0.0)
        self.time_ns: int | None = None

    def step(self, now_ns: int, command: Command | None) -> Reading:
        """Brings the body to `now_ns` under what was asked of it, then asks the next of it."""
        while self.time_ns is not None and self.time_ns < now_ns:
            step_ns = min(now_ns - self.time_ns, round(self.setup.period_s * 1e9))
            self.move(step_ns / 1e9)
            self.time_ns += step_ns
            if self.time_ns < now_ns:  # its process slept: a motor that hears nothing stops
                self.asked = self.brake()
        self.time_ns, self.asked = now_ns, command or self.brake()
        return Reading(now_ns, self.pose, *self.asked)

    def brake(self) -> Command:
        """What stops the body in a few tenths of a second."""
        robot, rate = self.setup.robot, 1.0 / max(0.1, self.setup.period_s)
        return Command(
            -robot.mass_kg * self.pose.speed * rate, -robot.inertia_kgm2 * self.pose.yaw_rate * rate
        )

    def move(self, dt: float) -> None:
        """The body after `dt` seconds."""
        robot, ground, (x, y, heading, speed, yaw_rate) = self.setup.robot, self.setup.settings, self.pose
        aside = -ground.slip * speed * yaw_rate
        x += (speed * cos(heading) - aside * sin(heading)) * dt
        y += (speed * sin(heading) + aside * cos(heading)) * dt
        heading += yaw_rate * dt
        speed += (self.asked.force - ground.drag * speed) / robot.mass_kg * dt
        spin = self.asked.torque - ground.drag * robot.hand_offset_m**2 * yaw_rate
        self.pose = Pose(x, y, heading, speed, yaw_rate + spin / robot.inertia_kgm2 * dt)
