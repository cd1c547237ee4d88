"""Following a muscle that changes, on the emulated rig in real time: test, approval, ten trials, for each case.

    python -m bench.tracking_on_rig [--seeds 94101 94102 94103] [--cases …] [--who …] [--json FILE] [--offline FILE]

Muscles and cases are those of `bench.tracking`; every session is on a rig of its own, from a rested muscle. The
controller is `examples/ilc_controller.py`. Rows that FILE holds already are not played again, so a long run can be
done in parts. Writes docs/results/tracking.md; `--offline` adds what `bench.tracking --json` wrote.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from bench.common import RESULTS, TOKEN, keep_lines, lines_of, parser, table, written_by
from bench.ilc import Patient
from bench.tracking import (
    APPROVAL_S,
    CASES,
    LARGEST_US,
    NOISE_NM,
    PEAK_SHARE,
    REST_S,
    TRIALS,
    moved_lines,
    moves,
    patient,
    seconds_of,
    tables,
)
from bench.tracking_rivals import FOLLOWERS, OURS, UNTRACKED, Follower
from examples import ilc_controller as ilc
from stimrig.api.cli.launcher import Services
from stimrig.api.client.rest import Client
from stimrig.api.settings import Settings
from stimrig.identify.model import Model
from stimrig.identify.records.recording import read_recording

PERSON = "TRACK"
LIMITS = {"gain_percent": 60.0, "threshold_percent": 60.0, "time_scale_percent": 60.0}
"""So far the muscle may be followed; the usual limits would ask for a new test after half of the fatigue."""


class KeepingClient(Client):
    """Keeps the last recording that was fetched."""

    last = b""

    def recording(self, recording_id: str) -> bytes:
        """The sealed recording."""
        self.last = super().recording(recording_id)
        return self.last


class Session(Patient):
    """A participant who rests before each trial; the service follows the model, or a peer does it here."""

    client: KeepingClient
    follower: Follower | None = None

    def __init__(self, client: KeepingClient, keep: Path | None) -> None:
        super().__init__(client, PERSON)
        self.keep = keep
        self.served: list[dict[str, Any]] = []
        self.sent_us: list[np.ndarray] = []
        self.seconds: list[float] = []

    def play(self, widths_us: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """After a rest."""
        time.sleep(REST_S)
        torque_nm, sent_us = super().play(widths_us)
        self.sent_us.append(sent_us)
        if self.keep is not None:
            (self.keep / f"trial-{len(self.sent_us):02d}.h5").write_bytes(self.client.last)
        return torque_nm, sent_us

    def fetch_followed(self) -> dict[str, Any]:
        """What the service serves after the trial just played, or what a peer makes of it."""
        began = time.perf_counter()
        if self.follower is None:
            document = super().fetch_followed()
        else:
            document = self.follower.learn(read_recording(self.client.last, Path("trial.h5")))
        self.seconds.append(time.perf_counter() - began)
        self.served.append(document.get("tracking", {}))
        return document


def patient_file(seed: int, case: str, path: Path) -> Path:
    """The emulator's file of that muscle."""
    rows = "".join(f"{name} = {float(value)!r}\n" for name, value in patient(seed, case).items())
    path.write_text(f'patient = "changing"\n[parameters]\n{rows}')
    return path


def one(seed: int, case: str, who: str, folder: Path, keep: Path | None = None) -> dict[str, Any]:
    """One session; its trials' recordings and the approved model go to `keep`."""
    file = patient_file(seed, case, folder / "patient.toml")
    emulator = ["--patient", str(file), "--noise-seed", str(seed), "--rate-hz", "400"]
    with Services(Settings(data_dir=folder / "data", port=0), emulator, TOKEN) as services:
        service = Session(KeepingClient(services.url, TOKEN), keep)
        client = service.client
        client.make_participant(PERSON, {"current_ma": 20.0, "max_pulse_width_us": LARGEST_US, "max_torque_nm": 30.0})
        test = client.run_test(PERSON)
        client.approve(test["model_id"], "the bench plays, nobody is connected", tracking=LIMITS)
        document = service.fetch()
        if keep is not None:
            keep.mkdir(parents=True, exist_ok=True)
            (keep / "MODEL.json").write_text(json.dumps(document))
        make = FOLLOWERS[who]
        if make and who != OURS:
            own = read_recording(client.recording(test["recording_id"]), Path("test.h5"))
            service.follower = make(Model.from_dict(document), own)
        reference = ilc.Reference.reach(PEAK_SHARE * float(document["recruitment"]["inverse"]["torque_nm"][-1]))
        time.sleep(APPROVAL_S - REST_S)
        done = ilc.learn(service, document, reference, "norm-optimal", TRIALS, tracked=bool(make))
        followed = client.tracking(PERSON)["trials"]
    return {
        "seed": seed,
        "case": case,
        "who": who,
        "errors": but_lost(done, service.sent_us, ilc.Plant(document, reference.torque_nm.size), reference),
        "errors_as_played": [trial.error_percent for trial in done],
        "lost": sum(trial.lost_pulses for trial in done),
        "lost_in_test": test["summary"]["dropped_pulses"],
        "repeated": service.repeated,
        "seconds": service.seconds,
        "delays_s": [trial["delay_s"] for trial in followed if trial["delay_s"] is not None],
        "moves": moves(service.served),
        "outcomes": [served.get("outcome") for served in service.served],
    }


def but_lost(
    done: list[ilc.Trial], sent_us: list[np.ndarray], plant: ilc.Plant, reference: ilc.Reference
) -> list[float]:
    """Errors without what the pulses that the rig dropped would have given by the approved model, %."""
    found = []
    for trial, sent in zip(done, sent_us, strict=True):
        lost_nm = plant.G @ (plant.level(trial.widths_us) - plant.level(sent))
        error_nm = reference.torque_nm - trial.torque_nm - lost_nm
        found.append(100 * float(np.sqrt(np.mean(error_nm**2))) / reference.rms_nm)
    return found


def page(rows: list[dict[str, Any]], offline: list[dict[str, Any]]) -> str:
    """The figures as a page."""
    lines = [
        "# Following a muscle that changes",
        "",
        f"{written_by('python -m bench.tracking_on_rig')}",
        "",
        f"Ten trials with {REST_S:g} s of rest between them, after a pre-session test and {APPROVAL_S:g} s of rest. "
        f"The reference goes up to {100 * PEAK_SHARE:g} % of the largest torque. "
        "Error: rms of reference minus torque, % of the reference's rms. In a table: the tenth trial's error, the "
        "median of the muscles; in brackets its ratio to that of the same muscle and follower when nothing changes, "
        "the median and the worst tenth.",
        f"The approval lets each quantity move by {LIMITS['gain_percent']:g} %; with the usual 20 % a new test is "
        "asked for as soon as more of the gain is lost.",
        "*Moved beyond a band*: what is served for the next trial differs from what was served before by more than "
        "half the width of the 95 % band that was served with it.",
        "",
        "What changes: " + "; ".join(f"{name} ({_words(what)})" for name, what in CASES.items() if what) + ". "
        "`hardware_sim/patients/changing.py` says by which laws.",
    ]
    if rows:
        lines += ["", "## On the emulated rig in real time", "", *rig_lines(rows)]
    if offline:
        seeds = sorted({row["seed"] for row in offline})
        lines += ["", "## Simulated, without waiting", ""]
        lines += [
            f"`python -m bench.tracking --seeds {seeds[0]}:{seeds[-1] + 1}`, noise {NOISE_NM:g} N·m; developed on "
            "seeds from 53000 and 54000. The controller that is not tracked halves its share after a worse trial; "
            "this costs it much with fatigue.",
            "",
        ]
        lines += [*tables(offline), "", *_list(seconds_of(offline)), "", *_list(moved_lines(offline))]
    return "\n".join(lines) + "\n"


def rig_lines(rows: list[dict[str, Any]]) -> list[str]:
    """Tables of the rig's sessions: the tenth trials, and each session by itself."""
    seeds = sorted({row["seed"] for row in rows})
    lines = [f"Muscles of the seeds {', '.join(map(str, seeds))}.", "", *tables(rows), ""]
    lines += [*_list(delay_lines(rows) + seconds_of(rows)), "", *_list(moved_lines(rows)), ""]
    lines += [
        "The rig drops a pulse when the computer is late for it; the more work runs beside it, the more are dropped. "
        "Errors are without what the approved model says these would have given; in the last column they are as "
        "played.",
        "",
    ]
    heads = "muscle; case; follower; error of trials 1 to 10, %; dropped pulses; trials repeated; as played"
    sessions = []
    for row in rows:
        errors, played = (", ".join(f"{e:.2f}" for e in row[key]) for key in ("errors", "errors_as_played"))
        sessions.append([row["seed"], row["case"], row["who"], errors, row["lost"], row["repeated"], played])
    return lines + table(heads.split("; "), sessions)


def delay_lines(rows: list[dict[str, Any]]) -> list[str]:
    """How long the service took."""
    delays_s = [delay for row in rows if row["who"] == OURS for delay in row["delays_s"]]
    if not delays_s:
        return []
    half, most = 1e3 * np.quantile(delays_s, [0.5, 0.99])
    words = f"From a trial's last sample to the tracked model served: {half:.0f} ms in the middle, p99 {most:.0f} ms, "
    return [f"{words}n = {len(delays_s)}. Below, *tracking* is what the controller waited for it."]


def _list(lines: list[str]) -> list[str]:
    return [f"- {line}" for line in lines]


def _words(what: dict[str, float]) -> str:
    return ", ".join(f"`{name}` {value:g}" for name, value in what.items())


def main() -> None:
    """Play what is not played yet, and write the page."""
    made = parser(__doc__)
    made.add_argument("--seeds", type=int, nargs="*", default=[94101, 94102, 94103])
    made.add_argument("--cases", nargs="*", default=list(CASES))
    made.add_argument("--who", nargs="*", default=[OURS, UNTRACKED])
    made.add_argument("--json", type=Path, help="rows, one a line; those in it are not played again")
    made.add_argument("--keep", type=Path, help="a folder for each session's recordings")
    made.add_argument("--offline", type=Path, help="rows of bench.tracking")
    options = made.parse_args()
    rows = lines_of(options.json)
    done = {(row["seed"], row["case"], row["who"]) for row in rows}
    wanted = [(s, c, w) for s in options.seeds for c in options.cases for w in options.who if (s, c, w) not in done]
    for seed, case, who in wanted:
        print(f"{seed}, {case}, {who}", file=sys.stderr, flush=True)
        with tempfile.TemporaryDirectory(prefix="tracking-") as folder:
            try:
                keep = options.keep and options.keep / f"{seed}-{case}-{who}".replace(" ", "-")
                rows.append(one(seed, case, who, Path(folder), keep))
            except (Exception, SystemExit) as error:  # the machine stood still: told, and played again another time
                print(f"{seed}, {case}, {who}: {error!r}", file=sys.stderr, flush=True)
                continue
        keep_lines(options.json, rows)
    words = page(rows, lines_of(options.offline))
    (RESULTS / "tracking.md").write_text(words, "utf-8")
    print(words)


if __name__ == "__main__":
    main()
