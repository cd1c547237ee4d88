"""The recordings, each from a seed: CSV in several forms, sealed recordings, MAT files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io

from bench.muscles import arm_records, recorders
from bench.muscles.hidden_records import generate, patient_record, write_csv
from tests.frozen.rig_records import KINDS, of_kind
from tests.harness import cohort_records

EFFECTS = (
    "activation_dependent_speed", "asymmetric_relaxation", "baseline_drift", "catch_like", "electromechanical_delay",
    "fatigue", "mains_hum", "mixed_fibres", "output_saturation", "passive_torque", "potentiation",
    "recruitment_hysteresis", "sensor_clipping", "series_compliance", "threshold_drift", "torque_angle",
    "torque_velocity", "tremor", "voluntary_effort",
)  # fmt: skip
OUTSIDE = ("after_discharge", "gain_jumps", "clonus", "rate_dependent_recruitment")
Make = Callable[[Path], Path]


def _csv(record: Callable[[], dict[str, Any]]) -> Make:
    def make(folder: Path) -> Path:
        write_csv(record(), folder / "record.csv")
        return folder / "record.csv"

    return make


def _as_another_recorder(kind: str, seed: int) -> Make:
    return _csv(lambda: recorders.recorded(generate("fatigue", "strong", seed, rate_hz=200), kind, seed))


def _sealed(session: cohort_records.Session) -> Make:
    return lambda folder: cohort_records.write(folder / "record.h5", session)


def _in_other_words(folder: Path) -> Path:
    """Another tool's file: other names, other units, a comma as the decimal sign."""
    record = generate(None, seed=41, rate_hz=100, design="short")
    rows = zip(record["time_s"] * 1e3, record["pulse_width_us"] / 1e3, record["torque_nm"] * 1e3, strict=True)
    lines = ["t;pw;Drehmoment", *(f"{t:.1f};{u:.5f};{y:.3f}".replace(".", ",") for t, u, y in rows)]
    (folder / "record.csv").write_text("\n".join(lines) + "\n")
    return folder / "record.csv"


def _mat(folder: Path) -> Path:
    record = generate("potentiation", "strong", 42, rate_hz=100, design="short")
    columns = {name: record[name] for name in ("time_s", "pulse_width_us", "torque_nm")}
    scipy.io.savemat(folder / "record.mat", columns | {"segment": np.asarray(record["segment"], object)})
    return folder / "record.mat"


def _arm(kind: str, seed: int) -> Make:
    return _csv(lambda: arm_records.record(arm_records.arm_patient(seed), kind, seed))


def _of_rig(kind: str) -> Make:
    """The last recording of a session on a rig."""

    def make(folder: Path) -> Path:
        files = of_kind(kind)
        name = max(name for name in files if name.endswith(".h5"))
        (folder / "record.h5").write_bytes(files[name])
        return folder / "record.h5"

    return make


RECORDS: dict[str, Make] = {
    **{name: _csv(lambda name=name: generate(name, "strong", 1100, rate_hz=50)) for name in EFFECTS},
    **{name: _csv(lambda name=name: generate(name, "strong", 1101, rate_hz=50)) for name in OUTSIDE},
    "plain": _csv(lambda: generate(None, seed=1102)),
    "plain_short": _csv(lambda: generate(None, seed=1103, design="short", rate_hz=50, with_validate=False)),
    "plain_ar1": _csv(lambda: generate(None, seed=1104, noise="ar1", rate_hz=100)),
    "plain_slow": _csv(lambda: generate(None, seed=1105, noise="slow", rate_hz=100)),
    "plain_steep": _csv(lambda: generate(None, seed=1106, steep=True, rate_hz=200)),
    "plain_pulsed": _csv(lambda: generate(None, seed=1107, pulsed=True, rate_hz=1600)),
    "pair": _csv(lambda: generate(("fatigue", "electromechanical_delay"), "strong", 1108, rate_hz=100)),
    "twice": _csv(lambda: generate("fatigue", "strong", 1109, rate_hz=100, again_after_s=60.0)),
    "patient": _csv(lambda: patient_record(1110)),
    **{f"as_{kind}": _as_another_recorder(kind, 1111) for kind in ("real", "gap", "negative", "start")},
    "arm_isometric": _arm("isometric", 1112),
    "arm_moving": _arm("moving", 1113),
    "arm_passive": _arm("passive", 1114),
    "sealed": _sealed(cohort_records.Session(seed=3, muscle=3, effect="fatigue")),
    "sealed_400": _sealed(cohort_records.Session(seed=4, muscle=4, design="full", rate_hz=400.0)),
    **{f"rig_{kind}": _of_rig(kind) for kind in KINDS if kind != "journal"},
    "other_words": _in_other_words,
    "mat": _mat,
}
IN_FULL = ("fatigue", "plain", "electromechanical_delay", "sealed", "rig_plain")
"""On these each verb and option is called, and both a fit and a diagnosis are kept."""
DIAGNOSED = (*EFFECTS, *OUTSIDE, "pair", "plain", "plain_slow", "sealed", "rig_plain")
"""A diagnosis begins with the plain fit, and depends on the record alone, whatever file it came from."""
FITTED = tuple(name for name in RECORDS if name in IN_FULL or name not in DIAGNOSED)
MORE_WORDS = {"other_words": "--map time_s=t:ms --map pulse_width_us=pw:ms --map torque_nm=Drehmoment:mNm"}
"""What every call on a recording says more."""
