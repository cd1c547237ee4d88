"""The search over an array's elements: what was believed, what a stimulus gave, which comes next."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stimrig.api.record_files import Progress
from stimrig.identify.electrodes import PRESETS, SPILLS, Layout, Search, Seen
from stimrig.identify.errors import BadRecord
from stimrig.identify.json_text import json_value
from stimrig.identify.records import bounds
from stimrig.identify.records.recording import read_recording

REST, HELD_S = "rest", 0.2
"""Segment before the stimulus; so long before its end the torque counts."""


def electrodes(
    progress: Progress,
    search: Mapping[str, Any],
    stimulus: Mapping[str, Any] | None = None,
    left_out: Sequence[Sequence[int]] = (),
) -> dict[str, Any]:
    """A search, with a stimulus more where one is given, and how it stands.

    `search`: as it was kept, or of a new one `positions_mm`, the name of the `wish`, `width_us`, `current_ma`,
    `farthest_mm` and `prior`. `stimulus`: `elements`, `recording`, `sign`, `spill` and `comfort`.
    """
    progress(0.1, "reading")
    found = Search.from_dict(search) if "seen" in search else _begun(search)
    torque_nm = None
    if stimulus is not None:
        torque_nm = stimulus["sign"] * rise_nm(Path(stimulus["recording"]))
        seen = Seen(torque_nm, SPILLS.index(stimulus["spill"]), stimulus["comfort"])
        found.add(stimulus["elements"], seen)
    progress(0.3, "searching")
    stop, best = found.enough() if found.seen else None, found.best()
    proposal = found.next([tuple(each) for each in left_out])
    standing = {
        "proposal": vars(proposal), "enough": stop and vars(stop), "best": best, "sure": found.sure(),
        "map": found.map(), "left_out": left_out,
    }  # fmt: skip
    return json_value({"search": found.to_dict(), "standing": standing, "torque_nm": torque_nm})


def _begun(asked: Mapping[str, Any]) -> Search:
    layout = Layout(tuple((float(x), float(y)) for x, y in asked["positions_mm"]))
    return Search(
        layout, PRESETS[asked["wish"]][1], asked["width_us"], asked["current_ma"], asked["prior"],
        farthest_mm=asked["farthest_mm"],
    )  # fmt: skip


def rise_nm(recording: Path) -> float:
    """Torque at the end of the hold above that at rest, N·m; flexion is positive. Raises BadRecord: no such test."""
    record = read_recording(bounds.content_of(recording), recording, channel=0)
    rest = record.torque_nm[record.segment == record.segment_names.index(REST)]
    late = record.time_s > record.time_s[-1] - HELD_S
    held = record.torque_nm[late]
    if not (rest.size and held.size and np.mean(record.pulse_width_us[late] > 0) > 0.5):  # a pulse or two may be lost
        raise BadRecord("no stimulus with a rest before it", place=recording.name, fix="Play it again.")
    return float(np.mean(held) - np.mean(rest))


VERBS = {"electrodes": electrodes}
