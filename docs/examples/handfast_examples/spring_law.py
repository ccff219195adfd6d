"""A spring and a damper along every edge, beside navigation: what most would write first."""

from dataclasses import dataclass
from math import hypot

from handfast import Law, Moment, setting


@dataclass(frozen=True)
class Spring:
    """Springs and dampers along edges."""

    stiffness: float = setting(1.0, "Pull per metre that an edge is too long.", unit="1/s2", ge=0, le=100)
    damping: float = setting(1.5, "Brakes how fast an edge changes.", unit="1/s", ge=0, le=100)


class SpringLaw(Law):
    """u = F_n + sum of weight (stiffness (d - rho) + damping (d' - rho')) n over the edges."""

    section = "spring"
    Settings = Spring

    def acceleration(self, now: Moment) -> tuple[float, float]:
        """m/s^2."""
        ax, ay = now.navigation
        for other in now.neighbours:
            dx, dy = now.position[0] - other.position[0], now.position[1] - other.position[1]
            rho = max(hypot(dx, dy), 1e-6)
            nx, ny = dx / rho, dy / rho
            vx, vy = now.velocity[0] - other.velocity[0], now.velocity[1] - other.velocity[1]
            push = self.settings.stiffness * (other.distance - rho)
            push += self.settings.damping * (other.rate - nx * vx - ny * vy)
            ax, ay = ax + other.weight * push * nx, ay + other.weight * push * ny
        return ax, ay
