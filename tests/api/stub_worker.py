"""Verbs of a worker that fits nothing: quick, and slow when asked to be.

`tests/api/thread_worker.py` does them in a thread, tests of processes in a process.
"""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from stimrig.api.jobs import curves as real_curves
from stimrig.api.record_files import find_recording, plain_csv, samples
from stimrig.identify.errors import BadRequest
from tests.api.made_up_joint import joint

Progress = Callable[[float, str], None]


class State(threading.local):
    """What one worker remembers, in a process or in a thread of its own."""

    pause: Callable[[float], Any] = staticmethod(time.sleep)
    die: Callable[[int], Any] = staticmethod(os._exit)
    advice, target = 0, 0.0
    """Answers since the adaptive test began, and its target."""


state = State()


FIGURES = {
    name: {"value": value, "sd": None, "unit": unit}
    for name, value, unit in (("threshold_us", 72.0, "µs"), ("plateau_nm", 6.0, "N·m"), ("saturation_us", 288.0, "µs"))
}


def model(effects: list[str]) -> dict[str, Any]:
    widths = list(range(0, 301, 5))
    torque = [max(0.0, (w - 60) / 40) if w < 300 else 6.0 for w in widths]
    identity = hashlib.sha256(f"{time.time_ns()}".encode()).hexdigest()[:12]
    return {
        "schema_version": "1.0", "model_id": f"M-{identity}", "sample_rate_hz": 40.0, "method": "maximum-likelihood",
        "pulse_rate_hz": 40.0, "created": "2026-01-01T00:00:00Z",
        "linear": {"b": [0.0, 0.002, 0.002], "a": [1.0, -1.93, 0.934], "delay_samples": 0,
                   "time_constant_s": 0.53, "damping": 0.64, "delay_s": 0.0},
        "recruitment": {"pulse_width_us": widths, "torque_nm": torque},
        "fit": {"fit_percent": 98.5, "held_out_fit_percent": 97.9, "rms_nm": 0.04, "held_out_rms_nm": 0.042,
                "ceiling_percent": 98.6, "noise_sd_nm": 0.04},
        "quality": {"verdict": "usable", "words": "Little is left to explain.", "reasons": [],
                    "gates": {"stable": {"passed": True, "severity": "refuse", "says": ""}}},
        "effects": [{"id": effect} for effect in effects], "uncertainty": {"figures": FIGURES},
        "data": {}, "software": {},
        **({"joint": joint()} if set(effects) & set(JOINT) else {}),
    }  # fmt: skip


def curves(progress: Progress, **_: Any) -> dict[str, Any]:
    time_s = [k / 10 for k in range(200)]
    torque = [k % 50 / 10 for k in range(200)]
    return {
        "time_s": time_s, "torque_nm": torque, "predicted_torque_nm": [y + 0.05 for y in torque],
        "pulse_width_us": [k % 300 for k in range(200)], "segments": [{"name": "prbs", "start_s": 0, "end_s": 20}],
        "step_response": {"time_s": [0, 1, 2], "response": [0, 0.8, 1.0]},
    }  # fmt: skip


def comparison(progress: Progress, **_: Any) -> dict[str, Any]:
    time_s = [k / 10 for k in range(200)]
    part = {"label": "prbs", "samples": 100, "rms_nm": 0.2, "mean_nm": 0.1, "share_of_excess": 1.0}
    return {
        "fit_percent": 97.0, "ceiling_percent": 98.6, "rms_nm": 0.12, "noise_sd_nm": 0.04,
        "held_out": {"rms_nm": 0.12},
        "by": {kind: [part] for kind in ("segment", "level", "direction", "time", "frequency")},

        "where": WHERE, "plain": [], "series": {"time_s": time_s, "residual_nm": [0.1] * 200, "noise_band_nm": 0.08},
        "tests": {"tests": [{"with": "y", "largest": 0.3, "band": 0.1, "passed": False, "words": "goes with torque"}]},
    }  # fmt: skip


JOINT = ("passive_torque", "torque_angle", "torque_velocity")
WHERE = [{
    "segment": "prbs", "start_s": 3.0, "end_s": 4.5, "pulse_width_us": [0.0, 300.0], "direction": "falling",
    "share_of_excess": 0.31,
    "text": "falling prbs, 0-300 µs: model too high by 0.4 N·m, 31 % of the error above the noise",
}]  # fmt: skip
SIGNATURES = {"time_s": [0.0, 1.0, 2.0], "fatigue": {"seen_nm": [0.0, 0.1, 0.2], "expected_nm": [0.0, 0.1, 0.15]}}
EXPERIMENT = {
    "effect": "fatigue", "rivals": ["fatigue", "threshold_drift"], "duration_s": 6.0, "decides": True,
    "text": "A ramp.",
    "segments": [{"name": "rest", "sequence": "rest", "settings": {"duration_s": 1}},
                 {"name": "ramp", "sequence": "ramp", "settings": {"up_s": 2, "down_s": 2}}],
    "dose": {"pulses": 80, "pulse_width_sum_us": 9000.0, "torque_time_nm_s": 9.0},
}  # fmt: skip


def found_missing(model_json: str | None) -> dict[str, Any]:
    held = [effect["id"] for effect in json.loads(model_json)["effects"]] if model_json else []
    missing = {
        "effect": "fatigue", "name": "Fatigue", "probability": 0.93, "rms_before_nm": 0.12, "rms_after_nm": 0.041,
        "held_out_rms_before_nm": 0.2, "held_out_rms_after_nm": 0.042, "confused_with": ["threshold_drift"],
        "next_experiment": "the ramp again", "plain": "The muscle tires.",
        "parameters": {"depth": {"value": 0.4, "sd": 0.05, "unit": "1"}},
    }  # fmt: skip
    tried = [{"effect": name, "log_evidence_gain": gain} for name, gain in (("fatigue", 90.0), ("tremor", -4.0))]
    against = "The evidence is against it: log evidence changes by -4.0."
    found = {
        "refused": [{"effect": "tremor", "log_evidence_gain": -4.0, "reason": against}],
        "structure": held, "verdict": "effect_missing", "noise_sd_nm": 0.04, "base": {}, "missing": [missing],
        "where": WHERE, "candidates": [tried], "experiment": EXPERIMENT, "signatures": SIGNATURES, "library": {},
        "notes": [],
    }  # fmt: skip
    if "fatigue" not in held:
        return found
    beside = [{"effect": "threshold_drift", "log_evidence_gain": 30.0}, tried[1]]
    missing |= {"effect": "threshold_drift", "name": "Threshold drift", "confused_with": []}
    return {**found, "missing": [missing], "candidates": [beside], "experiment": None, "signatures": {}}


def improvement(model_json: str | None) -> dict[str, Any]:
    held = [effect["id"] for effect in json.loads(model_json)["effects"]] if model_json else []
    new = "threshold_drift" if "fatigue" in held else "fatigue"
    steps = [{"added": added, "fit_percent": 97.0, "rms_nm": rms} for added, rms in ((None, 0.12), (new, 0.041))]
    models = [model(held), model([*held, new])]
    return {"verdict": "effect_missing", "noise_sd_nm": 0.04, "steps": steps, "models": models, "refused": []}


def carry(progress: Progress, data: str, model_json: str) -> dict[str, Any]:
    """Threshold drift is never needed again; the other effects always are."""
    folder, earlier = Path(data).parent, json.loads(model_json)
    if (folder / "does-not-carry").exists():
        raise BadRequest((folder / "does-not-carry").read_text())
    progress(0.3, "fitting last session's structure")
    while (folder / "carrying-slowly").exists():
        state.pause(0.05)
    held = [effect["id"] for effect in earlier["effects"]]
    needed = [effect for effect in held if effect != "threshold_drift"]
    rows = [
        {"effect": effect, "name": effect.capitalize(), "needed": effect in needed, "log_evidence_gain": 30.0,
         "required": 4.5, "why": "asked-for", "reason": "made up"}
        for effect in held
    ]  # fmt: skip
    found = {
        "carried_from": earlier["model_id"], "offered": "carried" if needed else "plain",
        "why": "better" if needed else "nothing-needed" if held else "plain-before", "reason": "A reason of the stub.",
        "still_needed": needed, "no_longer_needed": [effect for effect in held if effect not in needed],
        "undecided": [], "effects": rows, "figures": [],
    }  # fmt: skip
    return {"json": json.dumps(model(needed)) if needed else None, "found": found}


OPENING = [0.0] * 20 + [7.5 * k for k in range(1, 41)] + [0.0] * 20


def knowledge(percent: float) -> dict[str, Any]:
    widths = [5.0 * k for k in range(61)]
    torque = [max(0.0, (w - 60) / 40) for w in widths]
    return {
        "plateau_nm": 6.0, "curve_percent": percent, "step_percent": percent / 2,
        "recruitment": {"pulse_width_us": widths, "torque_nm": torque, "lower_nm": [t - percent / 20 for t in torque],
                        "upper_nm": [t + percent / 20 for t in torque]},
        "step_response": {"time_s": [0.0, 1.0, 2.0], "value": [0.0, 0.8, 1.0], "lower": [0.0, 0.7, 0.9],
                          "upper": [0.0, 0.9, 1.1]},
    }  # fmt: skip


def adaptive_advise(progress: Progress, **_news: Any) -> dict[str, Any]:
    """Each answer halves the bands, from 8 %; the target of 45 % is one at which the worker dies, of 44 % one at which
    it is slow."""
    state.advice += 1
    advice, target = state.advice, state.target
    percent = 16.0 * 0.5**advice
    if advice > 2 and target == 45.0:
        state.die(9)
    if advice > 2 and target == 44.0:
        state.pause(3)
    kind = "next" if target >= 44.0 or percent > target else "enough"
    widths = [100.0, 200.0] * 20
    segments = [{"name": f"step {advice}", "sequence": "widths",
                 "settings": {"pulse_width_us": widths, "jumps": True}}]  # fmt: skip
    return {
        "kind": kind, "segments": segments if kind == "next" else [], "expected_torque_time_nm_s": 2.0,
        "words": f"The curve is known within {percent:.1f} %, the step response within {percent / 2:.1f} %.",
        "knowledge": knowledge(percent), "least_known": {"pulse_width_us": 140.0, "time_s": 0.4},
    }  # fmt: skip


def track(progress: Progress, **arguments: Any) -> dict[str, Any]:
    """A gain 2 % lower each trial; `track.json` beside the recording says otherwise, once."""
    told = Path(arguments["data"]).parent / "track.json"
    wanted = json.loads(told.read_text()) if told.exists() else {}
    told.unlink(missing_ok=True)
    if wanted.get("die"):
        state.die(9)
    state.pause(wanted.get("slow_s", 0.0))
    error = None if arguments["reference_torque_nm"] is None else 7.5
    if "reason" in wanted:
        return {"error_percent": error, "reason": wanted["reason"]}
    before = arguments["state"] or {"trials": 0, "gain": 1.0}
    values = {"gain": before["gain"] * 0.98, "threshold_shift_us": 0.5, "time_scale": 1.0} | wanted.get("values", {})
    levels = {name: {"value": value, "low": value - 0.01, "high": value + 0.01} for name, value in values.items()}
    after = {"trials": before["trials"] + 1, "gain": values["gain"], "missed": arguments["missed"]}
    after["between"] = arguments["between"]
    step = {
        "outcome": wanted.get("outcome", "followed"), "trial": after["trials"], "now": levels, "coming": levels,
        "error_nm": wanted.get("error_nm", 0.04), "expected_error_nm": 0.04, "error_before_nm": 0.1, "torque_nm": 2.0,
        "disturbed_s": [], "distance": 2.0, "moved": list(arguments["bounds"]), "state": after,
    }  # fmt: skip
    moved = json.loads(arguments["model_json"])
    gain = values["gain"] if "gain" in arguments["bounds"] else 1.0
    moved["recruitment"]["torque_nm"] = [gain * y for y in moved["recruitment"]["torque_nm"]]
    return {"error_percent": error, "step": step, "model": json.dumps(moved)}


def fit(progress: Progress, data: str, effects: tuple[str, ...] | list[str] = (), **_: Any) -> dict[str, Any]:
    progress(0.5, "identifying")
    if "slow" in effects:
        state.pause(60)
    if "bad" in effects:
        raise BadRequest("no effect bad", place="effects", fix="Take one of fatigue, tremor.")
    while (Path(data).parent / "fitting-slowly").exists():
        state.pause(0.05)
    document = model([effect.partition(":")[0] for effect in effects])
    return {"json": json.dumps(document), "model": document, "notes": []}


def diagnosis(progress: Progress, data: str, model_json: str | None = None) -> dict[str, Any]:
    slow = Path(data).parent / "slow"
    progress(float(slow.read_text()) if slow.exists() else 0.5, "tried fatigue")
    if slow.exists():
        state.pause(60)
    found = found_missing(model_json)
    if (Path(data).parent / "nothing-missing").exists():
        found |= {"verdict": "nothing_missing", "missing": [], "where": [], "experiment": None, "signatures": {}}
    return {"rows": [found], "improvement": improvement(model_json)}


def adaptive_outlook(
    progress: Progress, target: dict[str, float], max_torque_time_nm_s: float, models: list[str], **_: Any
) -> dict[str, Any]:
    if target["step_percent"] == 49.0:
        state.pause(2.0)
    within = max_torque_time_nm_s >= 20.0
    words = "The target should be reached in about 9 s with 20 N·m·s."
    if not within:
        words = (
            "The target is probably out of reach: in about 4 s with 9 N·m·s the curve would be known within "
            "6.0 % and the step response within 3.0 %."
        )
    reach = {"reachable": within, "curve_percent": 1.9 if within else 6.0, "step_percent": 3.0, "seconds": 9.0,
             "torque_time_nm_s": 20.0, "words": words}  # fmt: skip
    return {"opening_us": OPENING, "reach": {**reach, "known": bool(models)}}


def adaptive_begin(progress: Progress, target: dict[str, float], **_: Any) -> dict[str, Any]:
    state.advice, state.target = 0, target["curve_percent"]
    return {}


def forecast(
    progress: Progress, pulse_width_us: list[float], pulse_rate_hz: float | None = None, **_: Any
) -> dict[str, Any]:
    return {"pulse_rate_hz": pulse_rate_hz or 40.0, "torque_nm": [width / 100 for width in pulse_width_us]}


def invert(progress: Progress, **arguments: Any) -> dict[str, Any]:
    wanted = arguments.get("reference_torque_nm") or [0.0, 1.0, 2.0]
    widths = [min(100.0 * torque, arguments["largest_us"] or 500.0) for torque in wanted]
    lacks = [{"begin_s": 0.025, "end_s": 0.05, "reason": "above-plateau", "shortfall_nm": 0.5}]
    return {
        "pulse_rate_hz": 40.0, "duration_s": len(wanted) / 40, "reference_torque_nm": wanted,
        "pulse_width_us": widths, "predicted_torque_nm": [width / 100 for width in widths],
        "unreachable": lacks, "fit_percent": 90.0, "whole_fit_percent": 80.0, "tolerance_nm": 0.1,
    }  # fmt: skip


def join(progress: Progress, parts: list[str], out: str, needs: list[str], **_: Any) -> dict[str, Any]:
    if needs and (Path(parts[0]).parent / "no-angle").exists():
        words = "it has no angle_rad, which an effect of the model needs"
        raise BadRequest(words, place="recording 2", fix="Leave it out.")
    Path(out).write_text("\n".join(parts))
    return {"file_sha256": "0" * 64}


def effects(progress: Progress) -> dict[str, Any]:
    names = ("fatigue", "tremor", "threshold_drift", "slow", "bad", *JOINT)
    words = dict.fromkeys(("name", "stage", "equation", "source", "signature", "separated_by", "plain"), "made up")
    lists = {name: [] for name in ("parameters", "forms", "confused_with", "needs")}
    flags = {"predictable": True, "free": False}
    return {"effects": [{"id": name, **words, **lists, **flags} for name in names]}


def busy(progress: Progress, seconds: float) -> dict[str, Any]:
    state.pause(seconds)
    return {}


def nothing(progress: Progress, **_: Any) -> dict[str, Any]:
    return {}


def hostile(progress: Progress, data: str) -> dict[str, Any]:
    """What a hostile file may do to the process that reads it."""
    if data == "memory":
        return {"size": len(bytearray(1 << 40))}
    if data == "loop":
        while True:
            pass
    if data == "output":
        return {"text": "x" * (1 << 27)}
    if data == "file":
        with tempfile.TemporaryFile() as file:
            os.posix_fallocate(file.fileno(), 0, 1 << 30)
    if data in ("crash", "killed"):
        os.kill(os.getpid(), 11 if data == "crash" else 9)
    if data == "exit":
        raise SystemExit(3)
    return hostile(progress, data)  # recursion without an end


VERBS: dict[str, Callable[..., dict[str, Any]]] = {
    verb.__name__: verb
    for verb in (
        fit, carry, comparison, curves, diagnosis, adaptive_outlook, adaptive_begin, adaptive_advise, track, forecast,
        invert, join, effects, busy, plain_csv, find_recording, samples, real_curves.recorded, hostile,
    )
} | dict.fromkeys(("warm", "track_warm"), nothing)  # fmt: skip
