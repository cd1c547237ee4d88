"""Sealed recordings of simulated muscles for cohorts, in the layout of docs/recording.md, written apart from the rig.

A muscle is simulated once; its sessions differ by the noise of the cell, so that thousands of them are made in minutes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from bench.muscles.hidden_records import generate

PULSES_HZ = 40.0
NOISE_NM = 0.035
"""Of a session, beside the 0.02 N·m that the muscle was simulated with."""


@dataclass(frozen=True)
class Session:
    """One session: whose, when, and the seed of its noise."""

    participant: str = "P001"
    day: str = "2026-01-05"
    seed: int = 0
    muscle: int = 0
    effect: str | None = None
    kind: str = "pre-session"
    design: str = "short"
    rate_hz: float = 100.0


@lru_cache(maxsize=256)
def muscle(seed: int, effect: str | None, design: str, rate_hz: float) -> dict[str, Any]:
    """The columns of one muscle's record."""
    return generate(effect, seed=seed, design=design, rate_hz=rate_hz, noise_sd_nm=0.02)


def write(path: Path, session: Session) -> Path:
    """A session as a sealed recording; the same session gives the same bytes of data."""
    record, rate_hz = muscle(session.muscle, session.effect, session.design, session.rate_hz), session.rate_hz
    torque_nm = record["torque_nm"] + NOISE_NM * np.random.default_rng(session.seed).standard_normal(
        record["time_s"].size
    )
    names = np.asarray(record["segment"])
    starts = np.flatnonzero(np.r_[True, names[1:] != names[:-1]])
    count = int(record["time_s"].size * PULSES_HZ / rate_hz)
    at = np.minimum(np.ceil(np.arange(count) * rate_hz / PULSES_HZ - 1e-9).astype(int), names.size - 1)
    planned_s, widths_us = np.arange(count) / PULSES_HZ, np.asarray(record["pulse_width_us"])[at]
    with h5py.File(path, "w") as file:
        file.attrs.update(
            format="stimrig-recording", format_version=1, recording_id=f"R-{session.participant}-{session.seed}",
            test_id=f"T-{session.seed}", participant=session.participant, kind=session.kind, outcome="completed",
            created_utc=f"{session.day}T09:00:00+00:00", software="stimrig 0", content_sha256="",
            pulse_rate_hz=PULSES_HZ,
        )  # fmt: skip
        columns = {
            "time_s": record["time_s"], "torque_nm": torque_nm, "counter": np.arange(names.size),
            "host_time_s": record["time_s"] + 0.001, "sync": np.full(names.size, 255, np.uint8),
        }  # fmt: skip
        for name, column in columns.items():  # as the rig compresses them
            file.create_dataset(f"/torque/{name}", data=column, compression="gzip", compression_opts=1, shuffle=True)
        file["/pulses/planned_time_s"] = planned_s
        file["/pulses/sent_pulse_width_us"] = widths_us
        file["/pulses/written_time_s"] = planned_s + 0.001
        file["/pulses/acknowledged_time_s"] = planned_s + 0.003
        file["/pulses/status"] = np.where(widths_us > 0, 0, 1).astype(np.uint8)
        file["/segments/name"] = [str(names[start]) for start in starts]
        file["/segments/start_s"] = starts / rate_hz
        file["/segments/end_s"] = np.r_[starts[1:], names.size] / rate_hz
    return path


def broken(folder: Path, good: Path) -> list[Path]:
    """Ten files that no recording is, each in a way of its own; `good` is a sound one."""
    whole = good.read_bytes()
    contents = {
        "empty.h5": b"",
        "half.h5": whole[: len(whole) // 2],
        "noise.h5": np.random.default_rng(1).bytes(4096),
        "magic-only.h5": whole[:8],
        "other.h5": whole.replace(b"stimrig-recording", b"nothing-recording"),
        "empty.csv": b"",
        "header.csv": b"time_s,pulse_width_us,torque_nm,segment\n",
        "words.csv": b"time_s,pulse_width_us,torque_nm,segment\n" + b"a,b,c,d\n" * 50,
        "short.csv": b"time_s,pulse_width_us,torque_nm,segment\n0,0,0,prbs\n0.025,100,1,prbs\n",
        "nul.mat": b"\0" * 2000,
    }
    made = []
    for name, content in contents.items():
        (folder / name).write_bytes(content)
        made.append(folder / name)
    return made


def cohort(folder: Path, sessions: int, people: int = 3, **more: Any) -> list[Path]:
    """So many sessions of some people, a folder each."""
    made = []
    for number in range(sessions):
        who, when = number % people, number // people
        place = folder / f"P{who + 1:03d}"
        place.mkdir(parents=True, exist_ok=True)
        day = str(np.datetime64("2026-01-05") + 7 * when)
        session = Session(f"P{who + 1:03d}", day, seed=number, muscle=who, **more)
        made.append(write(place / f"session-{number:05d}.h5", session))
    return made
