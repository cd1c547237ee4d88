"""A worker that speaks the protocol of `api.worker` but fits nothing: quick, and slow when asked to be."""

from __future__ import annotations

import hashlib
import json
import sys
import time
from typing import Any


def model(effects: list[str]) -> dict[str, Any]:
    widths = list(range(0, 301, 5))
    torque = [max(0.0, (w - 60) / 40) if w < 300 else 6.0 for w in widths]
    identity = hashlib.sha256(f"{time.time_ns()}".encode()).hexdigest()[:12]
    return {
        "schema_version": "1.0", "model_id": f"M-{identity}", "sample_rate_hz": 40.0, "method": "maximum-likelihood",
        "created": "2026-01-01T00:00:00Z",
        "linear": {"b": [0.0, 0.002, 0.002], "a": [1.0, -1.93, 0.934], "delay_samples": 0,
                   "time_constant_s": 0.53, "damping": 0.64, "delay_s": 0.0},
        "recruitment": {"pulse_width_us": widths, "torque_nm": torque},
        "fit": {"fit_percent": 98.5, "held_out_fit_percent": 97.9, "rms_nm": 0.04, "held_out_rms_nm": 0.042,
                "ceiling_percent": 98.6, "noise_sd_nm": 0.04},
        "effects": [{"id": effect} for effect in effects], "uncertainty": {}, "data": {}, "software": {},
    }  # fmt: skip


def curves() -> dict[str, Any]:
    time_s = [k / 10 for k in range(200)]
    torque = [k % 50 / 10 for k in range(200)]
    return {
        "time_s": time_s, "torque_nm": torque, "predicted_torque_nm": [y + 0.05 for y in torque],
        "pulse_width_us": [k % 300 for k in range(200)], "segments": [{"name": "prbs", "start_s": 0, "end_s": 20}],
        "step_response": {"time_s": [0, 1, 2], "response": [0, 0.8, 1.0]},
    }  # fmt: skip


def answer(verb: str, arguments: dict[str, Any], say: Any) -> dict[str, Any]:
    if verb == "fit":
        say(progress=0.5, text="identifying")
        if "slow" in arguments.get("effects", []):
            time.sleep(60)
        if "die" in arguments.get("effects", []):
            sys.exit(9)
        if "bad" in arguments.get("effects", []):
            return {
                "error": {"expected": True, "detail": "no effect bad. Take one of fatigue, tremor.", "place": "effects"}
            }
        document = model(list(arguments.get("effects", [])))
        return {"result": {"json": json.dumps(document), "model": document}}
    if verb == "comparison":
        return {"result": {"fit_percent": 98.5}}
    if verb == "curves":
        return {"result": curves()}
    if verb == "diagnosis":
        return {"result": {"verdict": "nothing_missing", "missing": [], "where": []}}
    if verb == "effects":
        return {"result": {"effects": [{"id": "fatigue"}]}}
    if verb == "find_recording":
        from api.jobs import find_recording

        return {"result": find_recording(lambda *_: None, **arguments)}
    return {"result": {}}


for line in sys.stdin:
    request = json.loads(line)

    def say(**fields: Any) -> None:
        print(json.dumps({"job": request["job"], **fields}), flush=True)  # noqa: B023

    say(**answer(request["verb"], request["arguments"], say))
