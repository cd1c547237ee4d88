"""Measure how much of unseen torque the 95 % bands of predictions hold, on muscles of the library and of other physics.

    python -m bench.bands [--seeds 2000:2008] [--sets plain,physics,…] [--protocol mixed] [--improve] [--json FILE]

The band is for the torque without noise. The second record is of the same muscle, rested, with other levels held
otherwise, and has neither noise nor a zero. `library`: each effect of the library's muscle, in turn, without those of
the sensor. Of each set: the mean share of points within the band, the lowest, and the median of the band's standard
deviation over the error.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from bench.common import bench_parser, table, write_json
from bench.muscles.hidden_records import sampled
from bench.muscles.other_physics import SETS
from bench.muscles.physics_records import FULL, NOISE_SD_NM, RATE_HZ, protocol_design, record_of_physics, unseen_design
from stimrig import identify
from stimrig.hardware_sim.hidden.design import make_design
from stimrig.hardware_sim.hidden.library import STILL
from stimrig.hardware_sim.hidden.scenario import draw_scenario, rng_of
from stimrig.identify.diagnosis import side_by_side as workers
from stimrig.identify.estimation.uncertainty import POINTWISE, prediction_band
from tests.harness.carried_sessions import as_record

LIBRARY = "library"
OF_SENSOR = {"mains_hum", "tremor", "voluntary_effort", "baseline_drift"}
"""What adds to the torque without being the muscle's answer: the unseen record would hold it, too."""
MUSCULAR = [effect for effect in STILL if effect not in OF_SENSOR]


def records_of(kinds: str, seed: int, protocol: str) -> tuple[identify.Record, identify.Record, str]:
    """Return a record, an unseen one of the same muscle without noise, and the muscle's kind."""
    if kinds != LIBRARY:
        columns = record_of_physics(kinds, seed, protocol=protocol)
        return as_record(columns), as_record(columns["unseen"]), columns["truth"]["kind"]
    effect = MUSCULAR[seed % len(MUSCULAR)]
    scenario, rng = draw_scenario((effect,), "middle", seed, noise_sd_nm=NOISE_SD_NM), rng_of(seed, "noise", protocol)
    top_us = float(np.floor(scenario.base.largest_width_us))
    played = (
        make_design(FULL, rng_of(seed, "played"), top_us) if protocol == FULL else protocol_design(protocol, top_us)
    )
    record = sampled(scenario, played, RATE_HZ, lambda count: rng.normal(0.0, NOISE_SD_NM, count))
    return as_record(record), as_record(sampled(scenario, unseen_design(seed, top_us), RATE_HZ, np.zeros)), effect


def held_by(model: identify.Model, unseen: identify.Record) -> dict[str, Any]:
    """Return the share of points that a model's band holds, its standard deviation, and the error, N·m, rms."""
    lower, upper = prediction_band(model, unseen)
    error = unseen.torque_nm - 0.5 * (lower + upper)
    return {
        "share": float(np.mean((lower <= unseen.torque_nm) & (unseen.torque_nm <= upper))),
        "sd_nm": float(np.sqrt(np.mean((upper - lower) ** 2)) / (2.0 * POINTWISE)),
        "error_nm": float(np.sqrt(np.mean(error**2))),
    }


def main() -> None:
    """Measure and print."""
    parser = bench_parser(__doc__, "2000:2008")
    parser.add_argument("--sets", default=",".join([*SETS, LIBRARY]), help="sets of muscles")
    parser.add_argument("--protocol", default="mixed", help="of the fitted record")
    parser.add_argument("--improve", action="store_true", help="the last model of `improve`, too")
    options = parser.parse_args()
    workers.WORKERS = 1
    rows: list[dict[str, Any]] = []
    for kinds in options.sets.split(","):
        for seed in options.seeds:
            record, unseen, kind = records_of(kinds, seed, options.protocol)
            models = {"fit": identify.fit(record)}
            if options.improve:
                models["improve"] = identify.improve(record).models[-1]
            for verb, model in models.items():
                parts = model.fit.get("contradiction")
                about = {"set": kinds, "seed": seed, "kind": kind, "model": verb}
                rows.append(about | held_by(model, unseen) | {"contradicts": bool(parts and parts["significant"])})
    write_json(options.json, rows)
    lines = []
    for verb in ("fit", "improve") if options.improve else ("fit",):
        for kinds in [*options.sets.split(","), "all"]:
            of_set = [row for row in rows if row["model"] == verb and kinds in (row["set"], "all")]
            shares = np.array([row["share"] for row in of_set])
            ratio = np.median([row["sd_nm"] / row["error_nm"] for row in of_set])
            alarms = f"{sum(row['contradicts'] for row in of_set)} of {len(of_set)}"
            figures = (f"{100 * np.mean(shares):.1f}", f"{100 * shares.min():.0f}", f"{ratio:.2f}", alarms)
            lines.append([verb, kinds, *figures])
    print(*table(["model", "set", "held, %", "lowest", "sd over error", "contradicts itself"], lines), sep="\n")


if __name__ == "__main__":
    main()
