"""How long the centre's pages ask a PostgreSQL database that holds five years of 20 rigs.

    python -m bench.centre_pages [--recordings 2000000] [--write]

A cluster of its own is filled by COPY: 20 rigs, 2000 participants, 184 000 sessions, 2 million recordings. Then each
page's questions are asked again and again, of participants drawn at random, through the same functions as the pages
ask them. `--write` renews docs/results/centre-pages.md.
"""

from __future__ import annotations

import gc
import hashlib
import json
import random
import time
from collections.abc import Callable, Iterable, Iterator
from datetime import date, timedelta
from itertools import chain
from typing import Any

import psycopg
from sqlalchemy import event, text

from bench.common import RESULTS, parser, spread, table, written_by
from stimrig.api.centre import directory, pages, warnings
from stimrig.api.centre.directory import Cohort, Search
from stimrig.api.charts import trend_charts
from stimrig.api.store import Store
from tests.harness.postgres import running

RIGS, PARTICIPANTS, DAYS = 20, 2000, 5 * 365
VERDICTS = ("usable",) * 7 + ("usable with care",) * 2 + ("not usable",)
EFFECTS = ("fatigue", "tremor", "passive_torque", "mains_hum", "catch_like", "potentiation", "baseline_drift")
SEEN = 300
GOAL_MS = 100.0
FIRST = date(2021, 1, 4)
BIG = ("centre_recordings", "centre_sessions", "centre_tests", "centre_models", "centre_decisions", "centre_effects")


class Trial:
    """Rows of a trial, drawn with a seed.

    Parameters
    ----------
    sessions, recordings : int
        How many.
    """

    def __init__(self, sessions: int, recordings: int, seed: int = 1) -> None:
        self.draw, self.sessions_count, self.recordings_count = random.Random(seed), sessions, recordings
        self.codes = [f"P{number:04}" for number in range(PARTICIPANTS)]
        self.sessions = list(self._sessions())

    def _sessions(self) -> Iterator[tuple[str, str, int, str]]:
        """Participant, day, rig, verdict; each participant stays at a rig, and one in ten changes to another."""
        seen: set[tuple[str, str, int]] = set()
        while len(seen) < self.sessions_count:
            code = self.codes[len(seen) % PARTICIPANTS]
            home = 1 + int(code[1:]) % RIGS
            rig = home if self.draw.random() < 0.9 else 1 + (home + 7) % RIGS
            day = (FIRST + timedelta(days=self.draw.randrange(DAYS))).isoformat()
            if (code, day, rig) not in seen:
                seen.add((code, day, rig))
                yield code, day, rig, self.draw.choice(VERDICTS)

    def tables(self) -> Iterator[tuple[str, Iterable[dict[str, Any]]]]:
        """Table and rows; in an order that foreign keys allow."""
        yield "centre_rigs", (
            {
                "id": n, "name": f"Ward {n:02}", "key_hash": f"{n:064}", "key_prefix": "stimrig_rig_",
                "created_utc": "2021-01-01T00:00:00.000Z", "created_by": "bench", "recordings": 100_000,
            }
            for n in range(1, RIGS + 1)
        )  # fmt: skip
        people: dict[tuple[str, int], list[str]] = {}
        for code, day, rig, _verdict in self.sessions:
            people.setdefault((code, rig), []).append(day)
        yield "centre_participants", (
            {
                "code": code, "rig_id": rig, "sessions": len(days), "recordings": 11 * len(days),
                "last_utc": f"{max(days)}T09:00:00.000Z", "verdict": "usable",
            }
            for (code, rig), days in people.items()
        )  # fmt: skip
        yield "centre_sessions", (
            {
                "participant": code, "day": day, "rig_id": rig, "at_utc": f"{day}T08:00:00.000Z", "tests": 2,
                "recordings": 11, "model_id": f"{code}-{day}", "model_utc": f"{day}T08:10:00.000Z", "verdict": verdict,
                "approved_by": "Ada" if verdict == "usable" else None,
            }
            for code, day, rig, verdict in self.sessions
        )  # fmt: skip
        yield "centre_models", (
            {
                "rig_id": rig, "id": f"{code}-{day}", "participant": code, "recording_id": f"{code}-{day}-0",
                "method": "maximum-likelihood", "effects": json.dumps(self._held()), "verdict": verdict,
                "fit": json.dumps(self._fit(verdict)), "created_utc": f"{day}T08:10:00.000Z",
                "file": _sha(f"m{code}{day}"), "file_bytes": 40_000,
            }
            for code, day, rig, verdict in self.sessions
        )  # fmt: skip
        yield "centre_tests", (
            {
                "rig_id": rig, "id": f"{code}-{day}-{n}", "participant": code, "kind": "pre-session",
                "state": "completed", "reason": "", "recording_id": f"{code}-{day}-{n}", "model_id": f"{code}-{day}",
                "requested_utc": f"{day}T08:0{n}:00.000Z",
            }
            for code, day, rig, _verdict in self.sessions for n in range(2)
        )  # fmt: skip
        yield "centre_decisions", (
            {
                "rig_id": rig, "sha256": _sha(f"d{code}{day}"), "participant": code, "model_id": f"{code}-{day}",
                "approved": verdict == "usable", "reason": "", "by": "Ada", "at_utc": f"{day}T08:12:00.000Z",
            }
            for code, day, rig, verdict in self.sessions
        )  # fmt: skip
        yield (
            "centre_effects",
            (
                {"effect": effect, "participant": code, "rig_id": rig}
                for code, rig in people
                for effect in self.draw.sample(EFFECTS, 2)
            ),
        )
        yield "centre_recordings", self._recordings()

    def _held(self) -> list[str]:
        return self.draw.sample(EFFECTS, self.draw.randrange(3))

    def _fit(self, verdict: str) -> dict[str, Any]:
        figures = {
            "threshold_us": (110, 2, "µs"), "plateau_nm": (21, 0.3, "N·m"), "time_constant_s": (0.06, 0.001, "s"),
            "damping": (0.8, 0.02, "1"), "delay_s": (0.025, 0.001, "s"), "fatigue.rate": (0.1, 0.01, "1/s"),
        }  # fmt: skip
        held = {
            name: {"value": value * self.draw.uniform(0.9, 1.1), "sd": sd, "unit": unit}
            for name, (value, sd, unit) in figures.items()
        }
        return {"verdict": verdict, "fit_percent": 92.1, "noise_sd_nm": 0.1, "words": "x" * 80, "figures": held}

    def _recordings(self) -> Iterator[dict[str, Any]]:
        each, more = divmod(self.recordings_count, len(self.sessions))
        for number, (code, day, rig, _verdict) in enumerate(self.sessions):
            for n in range(each + (number < more)):
                name, at_utc = f"{code}-{day}-{n}", f"{day}T08:{n:02}:{number % 60:02}.000Z"
                yield {
                    "rig_id": rig, "recording_id": name, "participant": code, "test_id": name, "origin": "rig",
                    "created_utc": at_utc, "file": _sha(f"{number} {n}"), "file_bytes": 1_200_000,
                }  # fmt: skip


def _sha(name: str) -> str:
    return hashlib.sha256(name.encode()).hexdigest()


def fill(address: str, trial: Trial) -> float:
    """Fill the tables; how long it took, s."""
    begun = time.monotonic()
    with psycopg.connect(address) as connection, connection.cursor() as cursor:
        for name, rows in trial.tables():
            first, count = next(rows := iter(rows)), 0
            with cursor.copy(f"COPY {name} ({', '.join(first)}) FROM STDIN") as copy:
                for row in chain([first], rows):
                    copy.write_row(list(row.values()))
                    count += 1
            print(f"{name}: {count} rows", flush=True)
    with psycopg.connect(address, autocommit=True) as connection:
        connection.execute("VACUUM ANALYZE")
    return time.monotonic() - begun


def questions(store: Store, codes: list[str], draw: random.Random) -> dict[str, Callable[[], Any]]:
    """What each page asks."""

    def a_person() -> None:
        code = draw.choice(codes)
        directory.person(store, code)
        directory.sessions(store, code)
        directory.stood(store, code)

    def later() -> None:
        day = (FIRST + timedelta(days=draw.randrange(DAYS))).isoformat()
        directory.sessions(store, draw.choice(codes), (day, 10))

    def drawn() -> None:
        code = draw.choice(codes)
        trend_charts.panels(pages.documents(code, directory.stood(store, code)))

    def search(**asked: Any) -> Callable[[], Any]:
        return lambda: directory.participants(store, Search(**asked))

    def listed(**asked: Any) -> Callable[[], Any]:
        return lambda: directory.recordings(store, Cohort(**asked), 500)

    return {
        "participant's page: all its queries": a_person,
        "participant's page: sessions from a day on": later,
        "participant's page: trend, with its drawing": drawn,
        "search: all, first page": search(),
        "search: code begins with P01": search(q="P01"),
        "search: a rig": search(rig_id=7),
        "search: sessions of a week": search(from_day="2023-05-01", to_day="2023-05-07"),
        "search: verdict within a month": search(verdict="not usable", from_day="2024-02-01", to_day="2024-02-29"),
        "search: effect at a rig": search(effect="tremor", rig_id=3),
        "search: effect, nobody found": search(effect="no_such_effect"),
        "recordings: first 500": listed(),
        "recordings: of a participant": lambda: directory.recordings(store, Cohort(draw.choice(codes)), 500),
        "recordings: of a rig and month": listed(rig_id=5, from_utc="2023-03-01", to_utc="2023-04-01"),
        "recordings: deep in the list": listed(after="2024-06-01T08:00:00.000Z~1"),
        "warnings": lambda: warnings.listed(store),
    }


def measured(ask: Callable[[], Any], times: int = SEEN) -> tuple[float, float]:
    """Median and 99th percentile, ms."""
    for _ in range(5):
        ask()
    found = []
    for _ in range(times):
        begun = time.perf_counter()
        ask()
        found.append(time.perf_counter() - begun)
    figures = spread(found)
    return figures["median"], figures["p99"]


def plans(store: Store, ask: Callable[[], Any]) -> list[str]:
    """How PostgreSQL finds what is asked: the scans of its plans."""
    asked: list[tuple[str, Any]] = []

    def heard(_connection: Any, _cursor: Any, statement: str, given: Any, *_more: Any) -> None:
        asked.append((statement, given))

    event.listen(store.engine, "before_cursor_execute", heard)
    ask()
    event.remove(store.engine, "before_cursor_execute", heard)
    scans = []
    with store.engine.connect() as connection:
        connection.execute(text("SELECT 1"))
        for statement, given in asked:
            if statement.startswith("SELECT"):
                rows = connection.exec_driver_sql(f"EXPLAIN {statement}", given).scalars().all()
                scans += [line.strip(" ->").split("  (")[0] for line in rows if "Scan" in line]
    return list(dict.fromkeys(scans))


def main() -> None:
    """Fill, ask, tell."""
    made = parser(__doc__)
    made.add_argument("--recordings", type=int, default=2_000_000)
    made.add_argument("--sessions", type=int, default=184_000)
    made.add_argument("--write", action="store_true", help="renew docs/results/centre-pages.md")
    given = made.parse_args()
    trial = Trial(given.sessions, given.recordings)
    with running() as cluster:
        address = cluster.empty("pages")
        store = Store(address)
        filled_s = fill(address, trial)
        with store.read() as session:
            size = session.execute(text("SELECT pg_database_size(current_database())")).scalar() or 0
            version = str(session.execute(text("SHOW server_version")).scalar()).split()[0]
        trial.sessions.clear()
        gc.collect()
        gc.freeze()  # a service does not hold a trial in its memory, which each collection would look through
        told, scans = [], {}
        for name, ask in questions(store, trial.codes, random.Random(2)).items():
            median_ms, p99_ms = measured(ask)
            told.append((name, median_ms, p99_ms))
            scans[name] = plans(store, ask)
            print(f"{name}: median {median_ms:.1f} ms, p99 {p99_ms:.1f} ms", flush=True)
            for scan in scans[name]:
                print(f"    {scan}", flush=True)
        store.close()
    words = page(given, told, scans, filled_s, size, version)
    if given.write:
        (RESULTS / "centre-pages.md").write_text(words, "utf-8")


def page(given: Any, told: list[tuple[str, float, float]], scans: dict[str, list[str]], filled_s: float, size: int,
         version: str) -> str:  # fmt: skip
    """The results file."""
    figures = [[name, f"{median:.1f}", f"{p99:.1f}"] for name, median, p99 in told]
    rows = "\n".join(table(["question", "median (ms)", "p99 (ms)"], figures))
    found = [[name, "<br>".join(scans[name]) or "–"] for name, *_ in told]
    plan = "\n".join(table(["question", "scans"], found))
    whole = sorted(
        {scan for found in scans.values() for scan in found if any(f"Seq Scan on {big}" in scan for big in BIG)}
    )
    seq = f"Read from end to end: {', '.join(whole)}." if whole else "None of the long tables is read from end to end."
    worst = next(p99 for name, _median, p99 in told if name.startswith("participant's page: all"))
    return f"""# The centre's pages at five years of 20 rigs

{written_by(f"python -m bench.centre_pages --recordings {given.recordings} --sessions {given.sessions} --write")}

{given.recordings} recordings, {given.sessions} sessions, {RIGS} rigs, {PARTICIPANTS} participants. PostgreSQL {version}
on 2 processors, with 32 MB of shared buffers. Filled by COPY in {filled_s:.0f} s; {size / 1e9:.2f} GB. Each question is
asked {SEEN} times through the functions that the pages call, of participants drawn at random.

Goal: a participant's page asks for less than {GOAL_MS:.0f} ms. Its 99th percentile is {worst:.1f} ms.

{rows}

## How PostgreSQL finds it

{seq}

{plan}
"""


if __name__ == "__main__":
    main()
