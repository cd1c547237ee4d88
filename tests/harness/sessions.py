"""A participant with many sessions, made through the store: emulated records on dates that lie weeks back.

The muscle is `tests.harness.muscle`'s; models come from `identify.fit`, rows from the store's own functions with a
clock that is set back. Everything follows from the seed.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

import stimrig
from stimrig import identify
from stimrig.api.clock import Clock
from stimrig.api.models.registry import Versions
from stimrig.api.store import Store
from stimrig.api.store.tables import Note, Participant, Recording, Test
from tests.harness.muscle import Patient
from tests.harness.patients import as_record

FIRST = datetime(2026, 8, 3, 11, 0, tzinfo=UTC)
"""The same day from Pago Pago to Auckland in winter, wherever the tests run."""
PROFILE = {"current_ma": 20.0, "max_pulse_width_us": 300.0, "max_torque_nm": 30.0}
RATE_HZ = 100
TOP_US = 300.0
BY = "Ada"


class SetBack(Clock):
    """A clock that stands at one time."""

    def __init__(self, at: datetime) -> None:
        self.at = at

    def unix_s(self) -> float:
        return self.at.timestamp()


@dataclass(frozen=True)
class Planned:
    """One session: its muscle, the day after the first one, what was decided, written and measured."""

    patient: Patient
    day: float
    approved: bool = True
    current_ma: float = 20.0
    notes: dict[str, str] = field(default_factory=dict)
    noise_nm: float = 0.04


def record(session: Planned, seed: int) -> identify.Record:
    """The session's test: random pulses, a ramp, a check."""
    rng = np.random.default_rng([seed, round(10 * session.day)])
    prbs = np.repeat(rng.integers(0, 2, 80), 6) * TOP_US
    up = np.linspace(0.0, TOP_US, 160)
    check = np.repeat(rng.uniform(0.0, TOP_US, 16), 20)
    parts = {"rest": np.zeros(40), "prbs": prbs, "ramp": np.r_[up, up[::-1]], "validate": check}
    widths = np.concatenate(list(parts.values()))
    names = np.concatenate([[name] * values.size for name, values in parts.items()])
    torque = session.patient.torque(widths, RATE_HZ)
    noisy = torque + session.noise_nm * rng.standard_normal(torque.size)
    return as_record(noisy, widths, RATE_HZ, list(names))


def make(store: Store, folder: Path, code: str, planned: list[Planned]) -> list[str]:
    """Store the sessions of a new participant; their models' ids, in order."""
    with store.write() as session:
        session.add(Participant(code=code, profile=dict(PROFILE), created_utc=label(FIRST), created_by=BY))
    return [_stored(store, folder, code, number, one) for number, one in enumerate(planned)]


def _stored(store: Store, folder: Path, code: str, number: int, one: Planned) -> str:
    at = FIRST + timedelta(days=one.day)
    at_utc, made = label(at), record(one, 1)
    test_id, recording_id = f"T-{code}-{number:03d}", f"R-{code}-{number:03d}"
    folder.mkdir(parents=True, exist_ok=True)
    path = stimrig.save(made, folder / f"{recording_id}.csv")
    plan: dict[str, Any] = {"test_id": test_id, "participant": code, "profile": {"current_ma": one.current_ma}}
    charge_uc = float(np.sum(made.pulse_width_us) * one.current_ma * 40.0 / RATE_HZ / 1000.0)
    test = Test(
        id=test_id, participant=code, kind="pre-session", state="completed", plan=plan, recording_id=recording_id,
        summary={"charge_uc": charge_uc, "duration_s": 35.0}, requested_by=BY, requested_utc=at_utc,
        finished_utc=at_utc,
    )  # fmt: skip
    recording = Recording(
        id=recording_id, participant=code, test_id=test_id, path=str(path), origin="rig", created_utc=at_utc,
        file_sha256=hashlib.sha256(path.read_bytes()).hexdigest(),
    )  # fmt: skip
    with store.write() as session:
        session.add(test)
        session.flush()
        session.add(recording)
        for kind, text in one.notes.items():
            name = f"N-{code}-{number}-{kind}"
            session.add(Note(id=name, participant=code, test_id=test_id, kind=kind, text=text, by=BY, at_utc=at_utc))
    versions = Versions(store, SetBack(at))
    model = versions.add(identify.fit(made).to_json(), code, recording_id, BY)
    if one.approved:
        versions.decide(model.id, True, BY, "as last time")
    return model.id


def label(at: datetime) -> str:
    """An ISO 8601 label."""
    return at.isoformat(timespec="milliseconds").replace("+00:00", "Z")
