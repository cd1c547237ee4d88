"""A centre under many rigs' load: lines cut at random, processes killed; figures: docs/results/centre.md.

    python -m bench.centre_load --rigs 20 --seed 1 [--sessions 5] [--recordings 11] [--megabytes 1.2] [--postgres]

Each rig is its service, without stimulator and with a worker that fits nothing, and its pusher. Recordings are at hand
and differ in their noise; they are uploaded through REST. Then the rigs' outboxes and the centre are compared.
"""

from __future__ import annotations

import argparse
import io
import os
import random
import shutil
import signal
import sys
import tempfile
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import h5py
import httpx
import numpy as np

from bench.centre_load_parts import PATIENCE_S, Kept, Lines, Seen, all_over, look
from bench.common import RESULTS, TOKEN, parser, table, written_by
from tests.harness.looks_first import LooksFirst
from tests.harness.postgres import free_port

CENTRE = [sys.executable, "-m", "stimrig.api.centre.server"]
"""The centre's process; its settings are STIMRIG_CENTRE_…"""
UPLOADERS = 3
SERVICE_KILLS, PUSHER_KILLS, CENTRE_KILLS = 1, 2, 6
SETTLE_S = 1200.0
SAMPLE_BYTES = 24


@dataclass
class Rig:
    """One rig: its folder, its service, its pusher, its line."""

    name: str
    folder: Path
    url: str
    service: Kept
    pusher: Kept
    line_port: int


def recording(rng: np.random.Generator, megabytes: float) -> bytes:
    """A recording like a sealed one in form and size: time, pulse width and torque with noise of its own."""
    samples = int(megabytes * 1e6 / SAMPLE_BYTES)
    time_s = np.arange(samples) / 1600.0
    width_us = np.where(time_s % 3 < 1.5, 200.0, 0.0)
    out = io.BytesIO()
    with h5py.File(out, "w") as file:
        file["time_s"], file["pulse_width_us"] = time_s, width_us
        file["torque_nm"] = 0.02 * width_us + rng.normal(0.0, 0.04, samples)
    return out.getvalue()


def rigs_of(count: int, folder: Path, keys: dict[str, str]) -> list[Rig]:
    """The rigs, not started."""
    made = []
    for name in (f"rig-{number:02d}" for number in range(count)):
        place = folder / name
        place.mkdir()
        port, line_port = free_port(), free_port()
        environment = {
            "STIMRIG_DATA_DIR": str(place), "STIMRIG_PORT": str(port), "STIMRIG_ADMIN_TOKEN": TOKEN,
            "STIMRIG_WORKERS": "1", "STIMRIG_CENTRE_URL": f"http://127.0.0.1:{line_port}",
            "STIMRIG_CENTRE_KEY": keys.get(name, "none"), "OPENBLAS_NUM_THREADS": "1",
        }  # fmt: skip
        url = f"http://127.0.0.1:{port}"
        service = Kept([sys.executable, "-m", "bench.stub_service"], environment, place / "api.log", f"{url}/health")
        pusher = Kept([sys.executable, "-m", "stimrig.api.outbox"], environment, place / "outbox.log")
        made.append(Rig(name, place, url, service, pusher, line_port))
    return made


def ask(rig: Rig, method: str, path: str, **given: object) -> httpx.Response:
    """Ask a service that may be killed meanwhile: again, until it answers."""
    end = time.monotonic() + 10 * PATIENCE_S
    while True:
        try:
            answer = httpx.request(method, f"{rig.url}{path}", auth=LooksFirst(TOKEN), timeout=PATIENCE_S, **given)  # pyright: ignore[reportArgumentType]
            if answer.status_code < 500:
                return answer
        except httpx.HTTPError:
            pass
        if time.monotonic() > end:
            raise RuntimeError(f"{rig.name} does not answer")
        time.sleep(0.5)


def day(rig: Rig, options: argparse.Namespace, seed: int) -> int:
    """One rig's day; how many uploads were answered."""
    rng = np.random.default_rng(seed)
    done = 0
    for session in range(options.sessions):
        code = f"P{session:03d}"
        ask(rig, "POST", "/v1/participants", json={"code": code})
        for number in range(options.recordings):
            data = recording(rng, options.megabytes)
            answer = ask(rig, "POST", f"/v1/participants/{code}/recordings", content=data)
            assert answer.status_code == 201, answer.text
            done += 1
            if number == options.recordings - 1:
                ask(rig, "POST", f"/v1/models/{answer.json()['model']['id']}/approve", json={"reason": "of the load"})
    return done


def chaos(rigs: list[Rig], centre: Kept, chance: random.Random, busy: threading.Event) -> None:
    """Kill each once or more, in any order, and start it again; go on until all were, even where the load has ended."""
    victims = [rig.service for rig in rigs] * SERVICE_KILLS + [rig.pusher for rig in rigs] * PUSHER_KILLS
    victims += [centre] * CENTRE_KILLS
    chance.shuffle(victims)
    for victim in victims:
        if busy.is_set():
            time.sleep(chance.uniform(0.5, 4.0))
        victim.kill()
        time.sleep(chance.uniform(0.1, 2.0))
        if victim.ended:
            return
        victim.start()


def main() -> None:
    """Play, compare, print and write; exit 1 where anything is lost, doubled, out of order or wrong."""
    made = parser(__doc__)
    for name, default in (("rigs", 20), ("seed", 1), ("sessions", 5), ("recordings", 11), ("megabytes", 1.2)):
        made.add_argument(f"--{name}", type=type(default), default=default)
    made.add_argument("--postgres", action="store_true", help="the centre's database is PostgreSQL")
    options = made.parse_args()
    began_s = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="centre-load-") as name, ExitStack() as ends:

        def leave(number: int, _frame: object) -> None:
            """Ctrl-C or SIGTERM: the days of the rigs are not waited for."""
            ends.close()
            shutil.rmtree(name, ignore_errors=True)
            os._exit(128 + number)

        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, leave)
        seen, figures = play(Path(name), options, ends)
    wall_s = time.monotonic() - began_s
    words = in_words(seen, {**figures, "wall time": f"{wall_s / 60:.1f} min"})
    print(words)
    command = "python -m bench.centre_load " + " ".join(sys.argv[1:])
    (RESULTS / "centre.md").write_text(document(command.strip(), options, words), encoding="utf-8")
    sys.exit(0 if seen.good else 1)


def play(folder: Path, options: argparse.Namespace, ends: ExitStack) -> tuple[Seen, dict[str, str]]:
    """The day with its harm, and what is where after it."""
    port = free_port()
    database = f"sqlite:///{folder}/centre/centre.db"
    if options.postgres:
        from stimrig.api.centre.postgres import Cluster

        folder.chmod(0o755)  # PostgreSQL's own user has to reach its part of it
        (folder / "postgres").mkdir()
        cluster = Cluster(folder / "postgres" / "cluster", free_port())
        ends.callback(cluster.stop)
        cluster.start()
        database = cluster.url
    (folder / "centre" / "files").mkdir(parents=True)
    environment = {
        "STIMRIG_CENTRE_DATA_DIR": str(folder / "centre"), "STIMRIG_CENTRE_PORT": str(port),
        "STIMRIG_CENTRE_ADMIN_TOKEN": TOKEN, "STIMRIG_CENTRE_DATABASE_URL": database,
        "STIMRIG_CENTRE_FILES": str(folder / "centre" / "files"),
    }  # fmt: skip
    centre = Kept(CENTRE, environment, folder / "centre.log", f"http://127.0.0.1:{port}/health")
    ends.callback(centre.end)
    centre.start()
    centre.wait_healthy()
    keys = {}
    for number in range(options.rigs):
        name = f"rig-{number:02d}"
        answer = httpx.post(
            f"http://127.0.0.1:{port}/v1/rigs", json={"name": name}, headers={"Authorization": f"Bearer {TOKEN}"}
        )
        keys[name] = answer.raise_for_status().json()["key"]
    rigs = rigs_of(options.rigs, folder, keys)
    for rig in rigs:
        for process in (rig.pusher, rig.service):
            ends.callback(process.end)
        rig.service.start()
    for rig in rigs:
        rig.service.wait_healthy()
        rig.pusher.start()
    lines = Lines([rig.line_port for rig in rigs], port, options.seed)
    ends.callback(lines.close)
    return harm_and_load(folder, database, options, rigs, centre, lines)


def harm_and_load(
    folder: Path, database: str, options: argparse.Namespace, rigs: list[Rig], centre: Kept, lines: Lines
) -> tuple[Seen, dict[str, str]]:
    """Load and harm at once, then calm, until all is over or time is up."""
    began_s, busy = time.monotonic(), threading.Event()
    busy.set()
    harm = threading.Thread(target=chaos, args=(rigs, centre, random.Random(options.seed), busy))
    harm.start()
    with ThreadPoolExecutor(UPLOADERS) as pool:
        days = [pool.submit(day, rig, options, 1000 * options.seed + number) for number, rig in enumerate(rigs)]
        uploads = sum(each.result() for each in days)
    load_s = time.monotonic() - began_s
    busy.clear()
    harm.join()
    lines.calm.set()
    calm_s = time.monotonic()
    folders, bucket = {rig.name: rig.folder for rig in rigs}, folder / "centre" / "files"
    while not all_over(folders, database, bucket) and time.monotonic() < calm_s + SETTLE_S:
        time.sleep(5)
    seen = look(folders, database, bucket)
    figures = {
        "uploads answered": str(uploads),
        "load": f"{load_s / 60:.1f} min",
        "from the last harm until all was over": f"{time.monotonic() - calm_s:.0f} s",
        "stretches without a line": ", ".join(f"{count} × {kind}" for kind, count in sorted(lines.stretches.items())),
        "killed (-9)": f"services {sum(r.service.kills for r in rigs)}, pushers {sum(r.pusher.kills for r in rigs)}, "
        f"centre {centre.kills}",
        "most memory of a pusher": f"{max(rig.pusher.peak_mb() for rig in rigs):.0f} MB",
        "most memory of the centre": f"{centre.peak_mb():.0f} MB",
        "processors, load average at the end": f"{os.cpu_count()}, {os.getloadavg()[0]:.1f}",
    }
    return seen, figures


def in_words(seen: Seen, figures: dict[str, str]) -> str:
    """The figures as a table."""
    kinds = ", ".join(f"{count} {kind}" for kind, count in seen.kinds.most_common())
    rows = {
        "items at the rigs / at the centre": f"{seen.items_at_rigs} / {seen.items_at_centre}",
        "of which": kinds,
        "files at the rigs / at the centre": f"{seen.files_at_rigs} / {seen.files_at_centre}",
        "lost items / files": f"{seen.lost_items} / {seen.lost_files}",
        "doubled": str(seen.doubled),
        "out of order": str(seen.out_of_order),
        "wrong hashes": str(seen.wrong_hashes),
        **figures,
    }
    return "\n".join(table(["", ""], rows.items()))


def document(command: str, options: argparse.Namespace, words: str) -> str:
    """The results file."""
    kind = "PostgreSQL" if options.postgres else "SQLite"
    sizes = f"{options.sessions} sessions of {options.recordings} recordings of {options.megabytes:g} MB"
    return f"""# A centre under a day's load

{written_by(command)}

{options.rigs} rigs, each its service and its pusher; {sizes} each, uploaded through REST as fast as this
machine takes them. No stimulator is connected, and the worker fits nothing, so there are no tests among the items.
The centre's database is {kind}; its bucket is a folder. Meanwhile each rig's line is cut or stalls for 1 to 10 s,
again and again, and services, pushers and the centre are killed (-9) at random and started again.

{words}
"""


if __name__ == "__main__":
    main()
