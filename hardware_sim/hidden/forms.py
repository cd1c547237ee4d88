"""An effect and its forms: each a stage of the muscle, where it comes from, and how its numbers are drawn.

A form is a kernel with two decorators: `draws` says where in the muscle it stands and how its numbers are drawn, the
effect's `form` (or `held_back`) what it is and whose it is::

    @EFFECT.form("gain falls with force", "Ding, Wexler and Binder-Macleod 2003")
    @draws("gain", 0.25, "alpha_per_s", tau_s=(40.0, 150.0))
    def _force_driven(x, p, s, c): ...

The kernel's p[0] is the magnitude, p[1:] are the drawn numbers in their order. A draw is `(low, high)`: uniform; a
list: one of it; a number: that number; or a function of generator and base, which may give several numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import partialmethod
from typing import Any, Literal

from numpy.random import Generator

from stimrig.hardware_sim.hidden.base import Base
from stimrig.hardware_sim.hidden.kernels import Kernel, Stage

Draw = Any
Counted = Literal["held out", "training", "larger", "all", "added"]
"""Error of a fit without an effect that counts as its strength: that in the held-out rows; in the training rows, where
it happens only there; the larger of both, where it may not show in the held-out rows; that of all rows, where it cannot
be predicted; or the rms of the torque added at the full rate, where it aliases at the pulse rate."""


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


class Numbers:
    """Several numbers of a stage drawn at once, and what is revealed of them."""

    def __init__(self, numbers: Iterable[float], **revealed: Any) -> None:
        self.numbers, self.revealed = tuple(numbers), revealed


def two_lags(_rng: Generator, base: Base) -> tuple[float, float]:
    """The base's two time constants, the shorter first; it must have them."""
    return base.two_lags_s()


def second_order(_rng: Generator, base: Base) -> tuple[float, float]:
    """1/Tω and ζ of the base."""
    return 1.0 / base.t_omega_s, base.zeta


def recruitment_table(_rng: Generator, base: Base) -> tuple[float, ...]:
    """The base's torque at every µs, N·m."""
    return tuple(base.table_nm)


@dataclass(frozen=True)
class Form:
    """A form of an effect; a call draws its numbers.

    `build(magnitude)` gives the stages of a drawn one, `build(magnitude, *numbers, state=…)` of one that is not. A
    stage in the slot `recruitment` or `dynamics` replaces the base's own. `magnitude_name` says what the magnitude is,
    with its unit. A name in `draws` that begins with `_` is not revealed. A `Sign` is no number: the magnitude is
    multiplied by it. `seed_at` is the place of a random generator's seed in the stage's state; it is drawn last. The
    name may be a function of what is revealed, `parameters`.
    """

    build: Callable[..., list[Stage]]
    largest_magnitude: float
    magnitude_name: str
    draws: Mapping[str, Draw]
    seed_at: int | None = None
    name: str | Callable[[dict[str, Any]], str] = ""
    source: str = ""
    parameters: dict[str, Any] = field(default_factory=dict)

    def __call__(self, rng: Generator, base: Base) -> Form:
        """The form with numbers drawn for this base; `NotSuited` where it does not suit it."""
        sign, numbers, revealed = 1.0, [], {}
        for name, draw in self.draws.items():
            if isinstance(draw, Sign):
                sign = draw.draw(rng)
                revealed[name] = draw.positive if sign > 0 else draw.negative
                continue
            if isinstance(draw, tuple | list):
                value = float(rng.uniform(*draw) if isinstance(draw, tuple) else rng.choice(draw))
            else:
                value = draw(rng, base) if callable(draw) else draw
            if isinstance(value, Numbers):
                numbers += value.numbers
                revealed |= value.revealed
                continue
            numbers += value if isinstance(value, list | tuple) else [value]
            if not name.startswith("_"):
                revealed[name] = value
        state = () if self.seed_at is None else (*[0.0] * self.seed_at, int(rng.integers(1, 2**31)))
        return replace(
            self,
            name=self.name(revealed) if callable(self.name) else self.name,
            build=lambda magnitude: self.build(sign * magnitude, *numbers, state=state),
            parameters=revealed,
        )


def draws(
    slot: str,
    largest_magnitude: float,
    magnitude_name: str,
    *,
    arrange: Callable[..., Iterable[float]] = lambda *numbers: numbers,
    seed_at: int | None = None,
    **numbers: Draw,
) -> Callable[[Callable[..., float]], Form]:
    """Decorate the kernel of a form in this slot.

    The stage's parameters are the magnitude and then all numbers in their order, or what `arrange` makes of these.
    """

    def decorate(function: Callable[..., float]) -> Form:
        kernel = Kernel(slot, function)

        def build(magnitude: float, *drawn_numbers: float, state: tuple[float, ...] = ()) -> list[Stage]:
            return [Stage(kernel, tuple(arrange(magnitude, *drawn_numbers)), state)]

        return Form(build, largest_magnitude, magnitude_name, numbers, seed_at)

    return decorate


@dataclass(frozen=True)
class Effect:
    """An effect that a muscle may hide; `moving` if it shows only where the joint moves.

    Forms that are held back are drawn from seed 1000 on only: nobody develops on them, so they tell how a diagnosis
    generalises.
    """

    counted: Counted = "held out"
    moving: bool = False
    forms: list[Form] = field(default_factory=list)
    held_back_forms: list[Form] = field(default_factory=list)

    def form(
        self, name: str | Callable[[dict[str, Any]], str], source: str, held_back: bool = False, **draws: Draw
    ) -> Callable[[Form], Form]:
        """Decorate a form with what it is and whose it is; `draws` take the place of its own."""

        def add(form: Form) -> Form:
            forms = self.held_back_forms if held_back else self.forms
            forms.append(replace(form, name=name, source=source, draws=draws or form.draws))
            return form

        return add

    held_back = partialmethod(form, held_back=True)
