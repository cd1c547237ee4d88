"""The hidden effects by name: those that the library of effects has, a file each, and those that no library has."""

from __future__ import annotations

from importlib import import_module
from pkgutil import iter_modules

from stimrig.hardware_sim.hidden import effects
from stimrig.hardware_sim.hidden.forms import Effect, Form
from stimrig.hardware_sim.hidden.outsiders import OUTSIDERS

HELD_BACK_FROM = 1000
"""Seeds from here on may also draw an effect's forms that are held back."""

EFFECTS: dict[str, Effect] = {
    name: import_module(f"{effects.__name__}.{name}").EFFECT
    for name in sorted(module.name for module in iter_modules(effects.__path__))
}
MOVING = frozenset(name for name, effect in EFFECTS.items() if effect.moving)
STILL = [name for name in EFFECTS if name not in MOVING]


def find_effect(name: str) -> Effect:
    """Return the effect of this name. Raises ValueError: there is none."""
    try:
        return {**EFFECTS, **OUTSIDERS}[name]
    except KeyError:
        raise ValueError(f"effect {name!r}: one of {', '.join((*EFFECTS, *OUTSIDERS))}") from None


def find_forms(effect: Effect, seed: int = HELD_BACK_FROM) -> list[Form]:
    """Return the forms of an effect; under seed 1000 without those held back from development."""
    return effect.forms if seed < HELD_BACK_FROM else effect.forms + effect.held_back_forms
