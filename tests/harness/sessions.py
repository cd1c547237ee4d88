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


class SetBack(Clock):
    """A clock that stands at one time."""

    def __init__(self, at: datetime) -> None:
        self.at = at

    def unix_s(self) -> float:
        return self.at.timestamp()


@dataclass(frozen=True)
class Planned:
    """One session.

    Parameters
    ----------
    patient : Patient
        The muscle on that day.
    day : float
        Days after the first one.
    approved : bool
        Whether somebody approved its model.
    current_ma : float
        Of its test.
    notes : dict of str to str
        Kind to text.
    noise_nm : float
        Noise of a torque sample.
    """

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


def make(store: Store, folder: Path, code: str, planned: list[Planned], seed: int = 1, by: str = "Ada") -> list[str]:
    """Store the sessions of a new participant; their models' ids, in order."""
    with store.write() as session:
        created = label(FIRST)
        session.add(Participant(code=code, profile=dict(PROFILE), created_utc=created, created_by=by))
    return [_stored(store, folder, code, number, one, seed, by) for number, one in enumerate(planned)]


def _stored(store: Store, folder: Path, code: str, number: int, one: Planned, seed: int, by: str) -> str:
    at = FIRST + timedelta(days=one.day)
    made = record(one, seed)
    versions = Versions(store, SetBack(at))
    test_id, recording_id = f"T-{code}-{number:03d}", f"R-{code}-{number:03d}"
    path = folder / f"{recording_id}.csv"
    digest = _written(path, made)
    charge_uc = float(np.sum(made.pulse_width_us) * one.current_ma * 40.0 / RATE_HZ / 1000.0)
    with store.write() as session:
        session.add(_test(test_id, code, one, label(at), recording_id, charge_uc, by))
        session.flush()
        row = Recording(id=recording_id, participant=code, test_id=test_id, path=str(path), file_sha256=digest)
        row.origin, row.created_utc = "rig", label(at)
        session.add(row)
        for kind, text in one.notes.items():
            note = Note(id=f"N-{code}-{number}-{kind}", participant=code, test_id=test_id, kind=kind, text=text)
            note.by, note.at_utc = by, label(at)
            session.add(note)
    model = versions.add(identify.fit(made).to_json(), code, recording_id, by)
    if one.approved:
        versions.decide(model.id, True, by, "as last time")
    return model.id


def _test(test_id: str, code: str, one: Planned, at_utc: str, recording_id: str, charge_uc: float, by: str) -> Test:
    plan: dict[str, Any] = {"test_id": test_id, "participant": code, "profile": {"current_ma": one.current_ma}}
    row = Test(id=test_id, participant=code, kind="pre-session", state="completed", plan=plan)
    row.summary, row.recording_id = {"charge_uc": charge_uc, "duration_s": 35.0}, recording_id
    row.requested_by, row.requested_utc, row.finished_utc = by, at_utc, at_utc
    return row


def _written(path: Path, made: identify.Record) -> str:
    """The record as a CSV file; its SHA-256."""
    names = [made.segment_names[index] for index in made.segment]
    rows = zip(made.time_s, made.pulse_width_us, made.torque_nm, names, strict=True)
    lines = [f"{t:.4f},{u:.2f},{y:.6f},{name}" for t, u, y, name in rows]
    text = "\n".join(["time_s,pulse_width_us,torque_nm,segment", *lines, ""])
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return hashlib.sha256(text.encode()).hexdigest()


def label(at: datetime) -> str:
    """An ISO 8601 label."""
    return at.isoformat(timespec="milliseconds").replace("+00:00", "Z")
