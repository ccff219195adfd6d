"""Robots agree how far the formation as a whole is from its way, and keep their places in it.

Each tells its neighbours what it takes that error for, and moves it towards theirs and towards its own. Who
is held back so holds back the others, which the shape survives.
"""

from dataclasses import dataclass

from handfast import Law, Moment, setting


@dataclass(frozen=True)
class Consensus:
    """Gains of the agreement and of the robots."""

    agreement: float = setting(2.0, "How fast robots go over to what neighbours say.", unit="1/s", gt=0, le=5)
    correction: float = setting(0.3, "How fast each goes over to its own error.", unit="1/s", gt=0, le=5)
    shape: float = setting(1.5, "Gain on the error within the formation.", unit="1/s2", gt=0, le=100)
    way: float = setting(0.3, "Gain on the error of the formation as a whole.", unit="1/s2", gt=0, le=100)
    damping: float = setting(1.8, "Gain on the velocity error.", unit="1/s", gt=0, le=100)


class ConsensusLaw(Law):
    """u = rddot_d - shape (e - agreed) - way agreed - damping edot; e = r - r_d."""

    section = "consensus"
    Settings = Consensus

    def restart(self) -> None:
        """Nothing is agreed yet."""
        self.numbers = ()

    def acceleration(self, now: Moment) -> tuple[float, float]:
        """m/s^2."""
        gains = self.settings
        said = [other.numbers for other in now.neighbours if len(other.numbers) == 2]
        agreed, wanted = [], []
        for k in range(2):
            error = now.position[k] - now.reference.position[k]
            speed = now.velocity[k] - now.reference.velocity[k]
            mine = self.numbers[k] if self.numbers else error
            rate = gains.correction * (error - mine)
            if said:
                rate += gains.agreement * (sum(each[k] for each in said) / len(said) - mine)
            agreed.append(mine + now.period * rate)
            pull = gains.shape * (error - agreed[k]) + gains.way * agreed[k]
            wanted.append(now.reference.acceleration[k] - pull - gains.damping * speed)
        self.numbers = tuple(agreed)
        return wanted[0], wanted[1]
