"""The fault campaign: each fault in each phase of a test, on several seeds; docs/results/faults.md holds its table."""

from __future__ import annotations

import argparse
import json
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path

from tests.harness.campaign.cases import CASES
from tests.harness.campaign.judge import Verdict
from tests.harness.campaign.log import Log
from tests.harness.campaign.runner import campaign, order
from tests.harness.campaign.table import table
from tests.harness.campaign.worker import Worker

ROOT = Path(__file__).parents[3]
DOCUMENT = ROOT / "docs" / "results" / "faults.md"
OUT = ROOT / "var" / "faults.jsonl"
BEGIN, END = "<!-- campaign: begin, written by python -m bench.faults -->", "<!-- campaign: end -->"
SHORT = 24


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


def _options(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="bench.faults", description=(__doc__ or "").splitlines()[0])
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
    return parser.parse_args(arguments)


def main(
    arguments: Sequence[str] | None = None,
    document: Path = DOCUMENT,
    make_worker: Callable[[int, float], Worker] = Worker,
) -> int:
    """Run, print, write the table into `document`; 1 where something is wrong or the campaign is not done."""
    options = _options(arguments)
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
        campaign(left, options.workers, options.speed, options.minutes, Progress(log, len(wanted)), ending, make_worker)
    if not log.sessions:
        raise SystemExit(f"bench.faults: {options.out} holds no injection")
    found = list(log.found.values())
    text = table(found, log.conditions())
    print(text)
    done = len(found) >= len(wanted)
    if options.table_only or (done and not (options.short or options.only)):
        write_between(document, text)
        print(f"written to {document}", file=sys.stderr)
    elif not done:
        print(f"{len(found)} of {len(wanted)}: --resume goes on, --table-only writes the table", file=sys.stderr)
    return 0 if done and not any(verdict.wrong or verdict.failed for verdict in found) else 1
