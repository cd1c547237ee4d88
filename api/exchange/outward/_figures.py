"""What several formats tell of a record beside its numbers: how a model fits it, and what it was made with."""

from __future__ import annotations

import json
from typing import Any, NamedTuple

from stimrig.api.cohort.whole_record import WholeRecord
from stimrig.api.version import software_version

NOT_TOLD = "not told"


class Figure(NamedTuple):
    """A figure of a fit: where MODEL.json has it, its unit there and in UCUM, and what it says."""

    name: str
    unit: str
    ucum: str
    says: str


FIGURES = (
    Figure("fit_percent", "%", "%", "how much of the torque the model explains, best fit"),
    Figure("held_out_fit_percent", "%", "%", "the same on rows that were not fitted"),
    Figure("rms_nm", "N·m", "N.m", "root mean square of what is left"),
    Figure("held_out_rms_nm", "N·m", "N.m", "the same on rows that were not fitted"),
    Figure("noise_sd_nm", "N·m", "N.m", "standard deviation of the white measurement noise"),
    Figure("threshold_us", "µs", "us", "pulse width at 5 % of the rise of the recruitment curve"),
    Figure("saturation_us", "µs", "us", "pulse width at 95 % of it"),
    Figure("plateau_nm", "N·m", "N.m", "torque of the curve's upper end"),
    Figure("time_constant_s", "s", "s", "time constant of the muscle's response"),
    Figure("damping", "1", "1", "damping of the muscle's response"),
    Figure("delay_s", "s", "s", "delay from pulse to torque"),
)


def fitted(record: WholeRecord) -> dict[str, Any]:
    """The figures of the plain model, fitted now as `stimrig fit` does it; `verdict` alone where none can be fitted."""
    from stimrig import identify
    from stimrig.identify.errors import IdentifyError

    try:
        document = identify.fit(record.record).to_dict()
    except IdentifyError as error:
        return {"verdict": f"no model: {' '.join(str(error).split())}"[:500]}
    read_off = {name: one["value"] for name, one in (document["uncertainty"].get("figures") or {}).items()}
    known = {**read_off, **document["fit"]}
    numbers = {one.name: known.get(one.name) for one in FIGURES}
    found = {name: float(value) for name, value in numbers.items() if isinstance(value, int | float)}
    return {**found, "verdict": document["quality"]["verdict"]}


def devices(record: WholeRecord) -> dict[str, str]:
    """Stimulator, load cell and software by what the recording says of them."""
    try:
        rig = json.loads(record.about.get("configuration") or "{}")["rig"]
        named = {kind: str(rig[kind]["device"]) for kind in ("stimulator", "load_cell")}
    except (ValueError, KeyError, TypeError, RecursionError):
        named = {}
    made_by = str(record.about.get("recorded_by") or record.about.get("software") or NOT_TOLD)
    return {
        "stimulator": named.get("stimulator", NOT_TOLD),
        "load cell": named.get("load_cell", NOT_TOLD),
        "software": f"{made_by}; exported by stimrig {software_version()}",
    }


def metadata(record: WholeRecord) -> str:
    """What the recording says of itself, as JSON; texts of the recording that are JSON stay texts."""
    plain = {key: value for key, value in record.about.items() if value is not None and key != "address"}
    return json.dumps({"stimrig": plain, "notes": list(record.notes)}, ensure_ascii=False, sort_keys=True, default=str)
