"""The log of a campaign: a line of JSON for each injection, so that one that was interrupted can be resumed."""

from __future__ import annotations

import json
import os
import platform
import time
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from tests.harness.campaign.judge import Verdict
from tests.harness.campaign.runner import Job
from tests.harness.commit import commit


class Log:
    """What was injected so far, a line of JSON each; a session's first line says under which conditions."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.sessions: list[dict[str, Any]] = []
        self.found: dict[Job, Verdict] = {}
        for line in path.read_text("utf-8").splitlines() if path.exists() else []:
            try:
                content = json.loads(line)
            except ValueError:  # cut off in the middle of it
                continue
            if "session" in content:
                self.sessions.append(content["session"])
            else:
                self._keep(Verdict(**content["verdict"]), content["at_s"])

    def _keep(self, verdict: Verdict, at_s: float) -> None:
        self.found[verdict.fault, verdict.phase, verdict.seed] = verdict
        self.sessions[-1]["took_s"] = at_s

    def begin(self, **conditions: Any) -> None:
        """A session begins: what differs from the one before would not be one campaign. Raises SystemExit."""
        fixed = ("seed", "speed")
        for before in self.sessions:
            if any(before[key] != conditions[key] for key in fixed):
                was = ", ".join(f"--{key} {before[key]:g}" for key in fixed)
                raise SystemExit(
                    f"bench.faults: {self.path} holds a campaign with {was}: resume with the same, or --out"
                )
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._began_s = time.monotonic()
        load = round(os.getloadavg()[0], 1)
        begun = {"utc": f"{datetime.now(UTC):%Y-%m-%d %H:%M}", "commit": commit(), "load": load, "took_s": 0.0}
        self.sessions.append({**conditions, **begun})
        self._append({"session": self.sessions[-1]})

    def add(self, verdict: Verdict) -> None:
        """One injection, on the disk when this returns."""
        at_s = round(time.monotonic() - self._began_s, 1)
        self._keep(verdict, at_s)
        self._append({"at_s": at_s, "verdict": asdict(verdict)})

    def _append(self, content: dict[str, Any]) -> None:
        cut_off = self.path.exists() and not self.path.read_bytes().endswith(b"\n")
        with self.path.open("a", encoding="utf-8") as file:
            file.write("\n" * cut_off + json.dumps(content) + "\n")
            file.flush()
            os.fsync(file.fileno())

    def conditions(self) -> str:
        """In words, for the table."""
        minutes = sum(session["took_s"] for session in self.sessions) / 60
        first = self.sessions[0]
        judged = sum(not verdict.failed for verdict in self.found.values())
        speed = "in real time" if first["speed"] == 1 else f"at {first['speed']:g} times the world's speed"
        loads = ", ".join(f"{session['load']:g}" for session in self.sessions)
        return (
            f"{judged} injections in {minutes:.1f} min on {self.sessions[-1]['utc']} UTC, "
            f"commit {self.sessions[-1].get('commit', 'not known')}, {speed}, "
            f"seed {first['seed']}, {first['workers']} emulated rigs at once on {os.cpu_count()} processors "
            f"({platform.machine()}, Python {platform.python_version()}); load average before it {loads}."
        )
