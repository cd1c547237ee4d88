"""LSL outlets against the sealed recording, and the lateness of pulses with and without them, in pairs.

    python -m bench.lsl [--pairs N] [--busy N] [--write]

Plays the default test (38.7 s, real time) on the emulated rig, in turn without and with the outlets and a recorder
beside. Printed: |t_lsl - t_recording| of each torque sample and each pulse; lateness of each pulse by the rig's own
record; the ratio of the 99th percentiles in each pair. `--write` writes docs/results/lsl.md.
"""

from __future__ import annotations

import contextlib
import os
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

import h5py
import numpy as np

from bench.common import RESULTS, emulated_rig, parser, spread, table, written_by
from tests.harness.lsl_recorder import Streams, compare, on_this_machine
from tests.harness.processes import Bench, RigClient, default_plan


@dataclass
class Found:
    """What was measured, s."""

    torque_apart_s: list[np.ndarray] = field(default_factory=list)
    pulses_apart_s: list[np.ndarray] = field(default_factory=list)
    without_s: list[np.ndarray] = field(default_factory=list)
    beside_s: list[np.ndarray] = field(default_factory=list)
    dropped: dict[str, int] = field(default_factory=lambda: {"without": 0, "with": 0})
    cpu_percent: list[float] = field(default_factory=list)
    load: list[float] = field(default_factory=list)


class Ended(Exception):
    """The rig ended a test: the machine stood still."""


def one(client: RigClient, test_id: str) -> tuple[Path, np.ndarray, int]:
    """Play a test: its recording, the lateness of its pulses (s), and how many were dropped."""
    reply = client.start(default_plan(test_id))
    if not reply["ok"]:
        raise SystemExit(reply["problem"]["detail"])
    event = client.wait_finished(test_id)
    if event["outcome"] != "completed":
        client.rearm("bench")
        raise Ended(event["reason"])
    with h5py.File(event["recording_path"]) as file:
        late_s = file["pulses/written_time_s"][:] - file["pulses/planned_time_s"][:]
    return Path(event["recording_path"]), late_s[np.isfinite(late_s)], event["summary"]["dropped_pulses"]


def cpu_s(pid: int) -> float:
    """Processor time of a process so far, s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def beside(bench: Bench, client: RigClient, test_id: str, found: Found) -> None:
    """One test with outlets and a recorder."""
    with Streams(bench, test_id, modest=True) as streams:
        before_s = cpu_s(streams.started[0].popen.pid)
        path, late_s, dropped = one(client, test_id)
        streams.wait_sent(test_id)
        found.cpu_percent.append((cpu_s(streams.started[0].popen.pid) - before_s) / 38.7 * 100)
        compared = compare(streams.end(), path)
    found.torque_apart_s.append(compared.torque_apart_s)
    found.pulses_apart_s.append(compared.pulses_apart_s)
    found.beside_s.append(late_s)
    found.dropped["with"] += dropped


def without(client: RigClient, test_id: str, found: Found) -> None:
    """One test without them."""
    _, late_s, dropped = one(client, test_id)
    found.without_s.append(late_s)
    found.dropped["without"] += dropped


def measure(pairs: int, busy: int) -> Found:
    """Play the pairs; every second one in the other order."""
    found = Found()
    with tempfile.TemporaryDirectory(prefix="lsl-bench-") as folder, contextlib.ExitStack() as stack:
        stack.enter_context(on_this_machine(Path(folder)))
        bench, client = stack.enter_context(emulated_rig("--noise-seed", "7", "--clock-ppm", "80", busy=busy))
        for pair in range(pairs):
            found.load.append(os.getloadavg()[0])
            steps = [
                lambda n=pair: without(client, f"without{n}", found),
                lambda n=pair: beside(bench, client, f"with{n}", found),
            ]
            try:
                for step in steps if pair % 2 == 0 else reversed(steps):
                    step()
            except Ended as error:
                raise SystemExit(f"pair {pair + 1}: the rig ended the test: {error}") from None
    return found


def percentiles(title: str, rows: dict[str, list[np.ndarray]]) -> list[str]:
    """A table of them, in ms."""
    values_s = {name: np.concatenate(values) for name, values in rows.items()}
    cells = [[name, len(s), *(f"{ms:.3f}" for ms in spread(s).values())] for name, s in values_s.items()]
    return table([title, "number", "p50", "p99", "max"], cells)


def report(found: Found, busy: int) -> str:
    """The tables."""
    p99 = np.array([[np.percentile(values, 99) for values in side] for side in (found.without_s, found.beside_s)])
    ratios = p99[1] / p99[0]
    shown = ", ".join(f"{ratio:.2f}" for ratio in ratios)
    pooled = np.percentile(np.concatenate(found.beside_s), 99) / np.percentile(np.concatenate(found.without_s), 99)
    lines = [
        f"{len(ratios)} pairs of the default test (38.7 s, 1600 samples/s, 40 pulses/s) on the emulated rig in real "
        f"time, {busy} busy processes beside. The recorder, which belongs on another computer, runs at the outlets' "
        f"priority. Load of the machine before each pair: "
        f"{', '.join(f'{load:.1f}' for load in found.load)} ({os.cpu_count()} processors).",
        "",
        *percentiles(
            "time stamp of LSL against the sealed recording, ms",
            {"torque samples": found.torque_apart_s, "pulses": found.pulses_apart_s},
        ),
        "",
        *percentiles(
            "lateness of pulses by the rig's own record, ms",
            {"without outlets": found.without_s, "with outlets and a recorder": found.beside_s},
        ),
        "",
        f"Ratio of the 99th percentiles, with to without: {pooled:.2f} over all pulses; in each pair {shown} "
        f"(median {np.median(ratios):.2f}). Pulses dropped: {found.dropped['without']} without, "
        f"{found.dropped['with']} with. The outlets took {np.mean(found.cpu_percent):.1f} % of one processor.",
    ]
    return "\n".join(lines)


def main() -> None:
    """Measure and print."""
    made = parser(__doc__)
    made.add_argument("--pairs", type=int, default=6)
    made.add_argument("--busy", type=int, default=0)
    made.add_argument("--write", action="store_true", help="write docs/results/lsl.md")
    options = made.parse_args()
    text = report(measure(options.pairs, options.busy), options.busy)
    print(text)
    if options.write:
        command = f"python -m bench.lsl --pairs {options.pairs} --busy {options.busy} --write"
        (RESULTS / "lsl.md").write_text(f"# LSL outlets\n\n{written_by(command)}\n\n{text}\n")


if __name__ == "__main__":
    main()
