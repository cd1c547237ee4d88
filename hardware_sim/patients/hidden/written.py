"""Ways of writing an effect down in one stage whose numbers are drawn one after another."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from numpy.random import Generator

from stimrig.hardware_sim.patients.hidden.base import Base
from stimrig.hardware_sim.patients.hidden.kernels import Formulation, Kernel, Stage

Draw = Any
"""How a number is drawn: `(low, high)` uniformly, a list: one of it, a number: that number, or a function of generator
and base that may give several."""


def even(rng: Generator) -> float:
    """1 or -1."""
    return float(rng.choice([-1.0, 1.0]))


def mostly(positive_share: float) -> Callable[[Generator], float]:
    """1 with this probability, otherwise -1."""
    return lambda rng: 1.0 if rng.random() < positive_share else -1.0


def weighted(negative_share: float, positive_share: float) -> Callable[[Generator], float]:
    """-1 and 1 with these probabilities."""
    return lambda rng: float(rng.choice([-1.0, 1.0], p=[negative_share, positive_share]))


@dataclass(frozen=True)
class Sign:
    """The magnitude's sign, and what is revealed where it is 1 and where it is -1."""

    draw: Callable[[Generator], float] = even
    positive: Any = 1.0
    negative: Any = -1.0


def two_lags(_rng: Generator, base: Base) -> tuple[float, float]:
    """The base's two time constants, the shorter first; it must have them."""
    return base.two_lags_s()


def second_order_of(_rng: Generator, base: Base) -> tuple[float, float]:
    """1/Tω and ζ of the base."""
    return 1.0 / base.t_omega_s, base.zeta


def largest_width_us(_rng: Generator, base: Base) -> float:
    """The largest pulse width that the base is sent."""
    return float(base.largest_width_us)


@dataclass(frozen=True)
class Written:
    """A formulation before its numbers are drawn; a call draws them.

    The stage's parameters are the magnitude and then all numbers, or what `arrange` makes of these. A name in `drawn`
    that begins with `_` is not revealed. A `Sign` is no number: the magnitude is multiplied by it. `seed_at` is the
    place of a random generator's seed in the stage's state; it is drawn last.
    """

    name: str
    source: str
    kernel: Kernel
    largest_magnitude: float
    magnitude_name: str
    drawn: Mapping[str, Draw] = field(default_factory=dict)
    arrange: Callable[..., tuple[float, ...]] = lambda *numbers: numbers
    seed_at: int | None = None

    def __call__(self, rng: Generator, base: Base) -> Formulation:
        """The formulation with numbers drawn for this base.

        Raises
        ------
        NotSuited
            It does not suit the base.
        """
        sign, numbers, revealed = 1.0, [], {}
        for name, draw in self.drawn.items():
            if isinstance(draw, Sign):
                sign = draw.draw(rng)
                value = draw.positive if sign > 0 else draw.negative
            else:
                value = _drawn(draw, rng, base)
                numbers += value if isinstance(value, list | tuple) else [value]
            if not name.startswith("_"):
                revealed[name] = value
        state = () if self.seed_at is None else (*[0.0] * self.seed_at, int(rng.integers(1, 2**31)))

        def build(magnitude: float) -> list[Stage]:
            return [Stage(self.kernel, self.arrange(sign * magnitude, *numbers), state)]

        return Formulation(self.name, self.source, build, self.largest_magnitude, self.magnitude_name, revealed)


def _drawn(draw: Draw, rng: Generator, base: Base) -> Any:
    if callable(draw):
        return draw(rng, base)
    if isinstance(draw, tuple):
        return float(rng.uniform(*draw))
    return float(rng.choice(draw)) if isinstance(draw, list) else draw
