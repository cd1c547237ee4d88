"""What a worker does to find what a model lacks: diagnosis, signatures, the next experiment, improving, joining.

Imported by the worker and the command line only.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stimrig import identify
from stimrig.api.structure import held_by
from stimrig.api.workers.json_values import clean
from stimrig.identify.records.join import write_joined

Progress = Callable[[float, str], None]
POINTS = 900
"""Points of a signature's curve: it is drawn small."""


def diagnosis(
    data: str, progress: Progress, model_json: str | None = None, columns: Sequence[str] | None = None
) -> dict[str, Any]:
    """What is missing in a model's structure, what each effect would explain, and the test that decides.

    Without a model it is the plain structure. The first four fifths of the progress are identify's diagnosis.
    """
    return diagnosed(identify.read(Path(data), map=columns), progress, model_json)


def diagnosed(record: Any, progress: Progress, model_json: str | None = None) -> dict[str, Any]:
    """The same of a record that was read."""
    from stimrig.identify import effects

    model = None if model_json is None else identify.Model.from_json(model_json)
    structure = held_by(model, record)
    found = identify.diagnose(record, model, lambda share, text="": progress(0.8 * share, text)).to_dict()
    found["structure"] = structure
    found["library"] = {entry["id"]: entry for entry in effects.library() if entry["id"] in mentioned(found)}
    progress(0.82, "what each effect would explain")
    found["signatures"] = signatures(record, [entry["effect"] for entry in found["missing"]], structure)
    found["experiment"] = experiment(found["missing"])
    return clean(found)


def mentioned(found: dict[str, Any]) -> set[str]:
    """Ids of all effects that a diagnosis speaks of."""
    named = {entry["effect"] for entry in found["missing"]}
    named |= {rival for entry in found["missing"] for rival in entry.get("confused_with") or []}
    return named | {row["effect"] for rows in found.get("candidates") or [] for row in rows}


def signatures(record: Any, effects: Sequence[str], structure: Sequence[str] = ()) -> dict[str, Any]:
    """What each effect explains of what the model before it leaves: seen beside expected.

    ``seen_nm`` is measurement minus the model before, ``expected_nm`` the model with the effect minus the model before.
    The first model is the structure criticised. An effect whose model cannot be fitted alone has none.
    """
    pick = slice(None, None, max(1, -(-record.time_s.size // POINTS)))
    found: dict[str, Any] = {"time_s": record.time_s[pick].round(4)}
    held = list(structure)
    before = np.asarray(identify.predict(identify.fit(record, effects=held), record))
    for effect in effects:
        held.append(effect)
        try:
            after = np.asarray(identify.predict(identify.fit(record, effects=held), record))
        except identify.IdentifyError:
            held.pop()
            continue
        seen = record.torque_nm - before
        found[effect] = {"seen_nm": smooth(record, seen)[pick].round(4), "expected_nm": (after - before)[pick].round(4)}
        before = after
    return found


def smooth(record: Any, values: Any) -> Any:
    """Running mean over a tenth of a second, so that a slow signature is seen through the noise."""
    width = max(1, round(0.1 * record.sample_rate_hz))
    padded = np.pad(values, (width // 2, width - 1 - width // 2), mode="edge")
    return np.convolve(padded, np.ones(width) / width, "valid")


def experiment(missing: Sequence[dict[str, Any]]) -> dict[str, Any] | None:
    """The test that separates the first effect with rivals from them; None where no effect has any."""
    from stimrig.identify.diagnosis.experiment import planned

    found = planned(missing)
    return found and {**found.to_dict(), "effect": found.rivals[0]}


def improve(data: str, progress: Progress, force: Sequence[str] = (), model_json: str | None = None) -> dict[str, Any]:
    """Effects added to a model's structure one by one while the evidence lasts, each step with its model."""
    record = identify.read(Path(data))
    model = None if model_json is None else identify.Model.from_json(model_json)
    structure = held_by(model, record)
    return {**identify.improve(record, progress, force=tuple(force), model=model).to_dict(), "structure": structure}


def joined(parts: Sequence[str], out: str, progress: Progress, needs: Sequence[str] = ()) -> dict[str, Any]:
    """Recordings as the parts of one, written to `out` as CSV that `identify.read` reads; its SHA-256.

    `needs` are columns that each of them must have.
    """
    from stimrig.api.workers import several

    progress(0.1, "joining the recordings")
    whole = several.read([Path(part) for part in parts], needs=needs, name=lambda number: f"recording {number + 1}")
    write_joined(whole, Path(out))
    with Path(out).open("rb") as file:
        return {"file_sha256": hashlib.file_digest(file, "sha256").hexdigest()}
