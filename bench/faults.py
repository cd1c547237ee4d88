"""The fault campaign: each fault, in each phase of a test, on several seeds; the table goes to docs/faults.md.

    python -m bench.faults [--resume] [--injections N] [--minutes M] [--workers N] [--seed N] [--speed N] [--out FILE]
    python -m bench.faults --table-only      writes the table of what --out holds

An emulator and a rig on it for each worker, in real time unless --speed says otherwise (then the rig's watches still
wait for real milliseconds). Every injection is appended to --out as a line of JSON at once: a campaign that was cut off
goes on with --resume. Times are real milliseconds. Needs root for a full disk (a small tmpfs).
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import random
import signal
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from bench.faults_cases import CASES, PHASES
from bench.faults_judge import Verdict
from bench.faults_table import table
from bench.faults_worker import Worker

ROOT = Path(__file__).parents[1]
DOCUMENT = ROOT / "docs" / "faults.md"
OUT = ROOT / "var" / "faults.jsonl"
BEGIN, END = "<!-- campaign: begin, written by python -m bench.faults -->", "<!-- campaign: end -->"
SHORT = 24

Job = tuple[str, str, int]


def order(injections: int, seed: int) -> list[Job]:
    """(fault, phase, number) of each injection: whole rounds of all faults in all phases, shuffled."""
    pairs = [(fault, phase) for fault in CASES for phase in PHASES]
    rng, jobs, round_ = random.Random(seed), [], 0
    while len(jobs) < injections:
        rng.shuffle(pairs)
        jobs += [(fault, phase, seed * 1000 + round_) for fault, phase in pairs]
        round_ += 1
    return jobs[:injections]


def campaign(
    jobs: list[Job],
    workers: int,
    speed: float,
    minutes: float,
    told: Callable[[Verdict], None] = lambda _: None,
    ending: threading.Event | None = None,
) -> list[Verdict]:
    """Make the injections.

    Parameters
    ----------
    minutes
        Begin none after that long.
    told
        Called with each verdict, one at a time.
    ending
        Begin none once it is set.
    """
    waiting, found, lock = list(reversed(jobs)), [], threading.Lock()
    end_s = time.monotonic() + 60 * minutes
    ending = ending or threading.Event()

    def work(number: int) -> None:
        worker = Worker(number, speed)
        try:
            while time.monotonic() < end_s and not ending.is_set():
                with lock:
                    if not waiting:
                        return
                    job = waiting.pop()
                verdict = worker.inject(*job)
                with lock:
                    found.append(verdict)
                    told(verdict)
        finally:
            worker.close()

    threads = [threading.Thread(target=work, args=(n,)) for n in range(workers)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return found


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
        self.sessions.append({**conditions, "utc": f"{datetime.now(UTC):%Y-%m-%d %H:%M}", "load": load, "took_s": 0.0})
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
            f"{judged} injections in {minutes:.1f} min on {self.sessions[-1]['utc']} UTC, {speed}, "
            f"seed {first['seed']}, {first['workers']} emulated rigs at once on {os.cpu_count()} processors "
            f"({platform.machine()}, Python {platform.python_version()}); load average before it {loads}."
        )


def write_between(path: Path, text: str) -> None:
    """Put the table between its marks; what people wrote around it stays. Raises SystemExit without such marks."""
    content = path.read_text("utf-8")
    before, begin, rest = content.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise SystemExit(f"bench.faults: {path}: the lines {BEGIN!r} and {END!r} must be in it")
    path.write_text(f"{before}{BEGIN}\n\n{text.strip()}\n\n{END}{after}", "utf-8")


class Progress:
    """A line for each injection that went wrong, and one now and then with the time that is left."""

    def __init__(self, log: Log, wanted: int) -> None:
        self._log, self._wanted, self._before = log, wanted, len(log.found)
        self._began_s = time.monotonic()
        self._said_s = 0.0

    def __call__(self, verdict: Verdict) -> None:
        self._log.add(verdict)
        if verdict.wrong or verdict.failed:
            print(json.dumps(asdict(verdict)), flush=True)
        now_s, done = time.monotonic(), len(self._log.found)
        if now_s - self._said_s < 10 and done < self._wanted:
            return
        self._said_s = now_s
        each_s = (now_s - self._began_s) / max(1, done - self._before)
        found = self._log.found.values()
        wrong, failed = sum(bool(v.wrong) for v in found), sum(bool(v.failed) for v in found)
        left_min = max(0.0, each_s * (self._wanted - done) / 60)
        print(
            f"{done} of {self._wanted}, {each_s:.1f} s each, {left_min:.0f} min left; {wrong} with anything wrong, "
            f"{failed} not judged",
            file=sys.stderr,
            flush=True,
        )


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--short", action="store_true", help=f"{SHORT} injections, no table")
    parser.add_argument("--injections", type=int, default=640)
    parser.add_argument("--minutes", type=float, default=35.0, help="begin none after that long, whatever is left")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--speed", type=float, default=1.0)
    parser.add_argument("--only", nargs="*", metavar="FAULT", choices=list(CASES), help="these faults alone, no table")
    parser.add_argument("--out", type=Path, default=OUT, help="a line of JSON for each injection; default var/")
    parser.add_argument("--resume", action="store_true", help="go on where the campaign in --out was cut off")
    parser.add_argument("--table-only", action="store_true", help="inject nothing, write the table of what --out holds")
    return parser.parse_args()


def main() -> None:
    """Run, print, write the table; exit 1 where something is wrong or the campaign is not done."""
    options = _options()
    if not (options.resume or options.table_only) and options.out.exists():
        options.out.replace(options.out.with_suffix(".previous.jsonl"))
    log = Log(options.out)
    wanted = order(SHORT if options.short else options.injections, options.seed)
    if options.only:
        wanted = [job for job in order(10_000, options.seed) if job[0] in options.only][: options.injections]
    left = [] if options.table_only else [j for j in wanted if j not in log.found or log.found[j].failed]
    if left:
        log.found = {job: verdict for job, verdict in log.found.items() if not verdict.failed}  # once more
        log.begin(seed=options.seed, speed=options.speed, workers=options.workers)
        ending = threading.Event()
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: ending.set())
        campaign(left, options.workers, options.speed, options.minutes, Progress(log, len(wanted)), ending)
    if not log.sessions:
        raise SystemExit(f"bench.faults: {options.out} holds no injection")
    found = list(log.found.values())
    text = table(found, log.conditions())
    print(text)
    done = len(found) >= len(wanted)
    if options.table_only or (done and not (options.short or options.only)):
        write_between(DOCUMENT, text)
        print(f"written to {DOCUMENT.relative_to(ROOT)}", file=sys.stderr)
    elif not done:
        print(f"{len(found)} of {len(wanted)}: --resume goes on, --table-only writes the table", file=sys.stderr)
    sys.exit(0 if done and not any(verdict.wrong or verdict.failed for verdict in found) else 1)


if __name__ == "__main__":
    main()
