"""Every effect of the library tried on a record: its likeliest form, and the evidence for it."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor, as_completed

from identify.effects.base import Effect, Form
from identify.estimation.adding import Candidate, names, try_effect
from identify.estimation.joint import Fitted
from identify.simulation.setup import Setup

WORKERS = 2
FORMS = 3
"""Forms of an effect tried beside another effect."""

Progress = Callable[[float, str], None]


def applicable(effect: Effect, setup: Setup, present: Iterable[str]) -> bool:
    """Whether an effect can be considered: its columns are there, it isn't sought elsewhere, it isn't in already."""
    record = setup.grid.record
    if effect.raw or effect.id in present:
        return False
    return all(getattr(record, need) is not None for need in effect.needs)


def likeliest_forms(effect: Effect, before: Candidate | None) -> list[Form]:
    """Forms worth a fit beside another effect: those that did best alone; chains are kept whole."""
    if before is None or effect.band or any(form.grows for form in effect.forms):
        return list(effect.forms)
    ranked = sorted(before.forms, key=lambda name: -before.forms[name])
    return [effect.form(name) for name in ranked[:FORMS]]


def scan(
    base: Fitted,
    effects: Iterable[Effect],
    progress: Progress | None = None,
    share: tuple[float, float] = (0.0, 1.0),
    before: list[Candidate] | None = None,
) -> list[Candidate]:
    """Every applicable effect added to a model, best first; `before` is what an earlier round found of them."""
    present = set(names(base))
    listed = [effect for effect in effects if applicable(effect, base.problem.setup, present)]
    done = 0
    found: list[Candidate] = []
    # Costly ones first, so that both workers end together; the compiled parts release the interpreter.
    listed.sort(key=lambda effect: -len(effect.forms))
    with ThreadPoolExecutor(WORKERS) as pool:
        earlier = {candidate.effect.id: candidate for candidate in before or []}
        waiting = {
            pool.submit(try_effect, effect, base, likeliest_forms(effect, earlier.get(effect.id))): effect
            for effect in listed
        }
        try:
            for future in as_completed(waiting):
                done += 1
                if progress is not None:
                    text = f"tried {waiting[future].name.lower()}"
                    progress(share[0] + (share[1] - share[0]) * done / len(listed), text)
                candidate = future.result()
                if candidate is not None:
                    found.append(candidate)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return sorted(found, key=lambda candidate: -candidate.gain)
