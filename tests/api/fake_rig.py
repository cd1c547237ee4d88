# ruff: noqa: ARG002
"""A rig that speaks `stimrig.rig.messages` on a Unix socket and plays a made-up test in a second or two."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import threading
import time
import traceback
from base64 import b64encode
from collections.abc import Iterable
from math import nan
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from stimrig.rig import archive  # with h5py, here: at a test's end it takes seconds while other threads import
from stimrig.rig import messages as m
from stimrig.rig import requests as rig_requests
from stimrig.rig.align import Alignment
from stimrig.rig.assembly import Recording
from stimrig.rig.phase import NO_PREVIEW
from tests.api.fake_arm import ZERO_S, FakeArm
from tests.api.fake_score import PULSE_RATE_HZ, FakeScore
from tests.harness.muscle import Patient

REQUESTS: TypeAdapter[Any] = TypeAdapter(rig_requests.Request)
FRAME_S = 0.05
SEQUENCES = ("prbs", "ramp", "rest", "widths")
PATIENT = Patient(gain=6.9, a2=1 / 25, a3=float(np.exp(6)))
STOPPED = "the computer stopped for 0.6 s; no current flowed meanwhile, and the test went on"
Laid = tuple[list[float], list[dict[str, Any]]]
"""Widths of the pulses and segments of a test."""


class Refusal(Exception):
    """Code, title and detail of a problem."""


def lay_out(pieces: Iterable[tuple[str, list[float]]]) -> Laid:
    """One piece after the other."""
    widths: list[float] = []
    segments = []
    for name, piece in pieces:
        start = len(widths) / PULSE_RATE_HZ
        widths += piece
        segments.append({"name": name, "start_s": start, "end_s": len(widths) / PULSE_RATE_HZ})
    return widths, segments


def default_widths() -> Laid:
    """1 s rest, 6 s of a switching input, 1 s rest, 5 + 5 s ramp, 1 s rest, 6 s of levels held out."""
    state, prbs = 0x5A, list[float]()
    while len(prbs) < 240:
        bit = (state ^ state >> 1) & 1
        state = state >> 1 | bit << 6
        prbs += [300.0 * bit] * 12
    ramp = [300.0 * min(k, 400 - k) / 200 for k in range(400)]
    levels = [[80.0, 220.0, 140.0, 260.0, 180.0, 0.0][k // 40] for k in range(240)]
    rest = ("rest", [0.0] * 40)
    return lay_out([rest, ("prbs", prbs), rest, ("ramp", ramp), rest, ("validate", levels)])


def widths_of(plan: m.TestPlan) -> Laid:
    """What a plan plays: a controller's rests and widths, the fixed plan of an adaptive test, or the default test."""
    for segment in plan.segments or []:
        if segment.sequence not in SEQUENCES:
            raise Refusal("bad-plan", "No such sequence", f"{segment.sequence!r}; there are {', '.join(SEQUENCES)}.")
    if plan.kind in ("sequence", "held") and plan.segments:
        rests = [[0.0] * round(s.settings.get("duration_s", 1.0) * PULSE_RATE_HZ) for s in plan.segments]
        pieces = zip(plan.segments, rests, strict=True)
        return lay_out((s.name, s.settings.get("pulse_width_us", rest)) for s, rest in pieces)
    if plan.adaptive is None:
        return default_widths()
    score = FakeScore(plan, [], [])
    score.go_on(1e9)
    return score.widths, [{key: s[key] for key in ("name", "start_s", "end_s")} for s in score.segments]


def muscle(widths: list[float], rate_hz: float) -> list[float]:
    """Torque of the patient with noise of 0.04 N·m, the same for the same widths."""
    torque = PATIENT.torque(np.array(widths), rate_hz, PULSE_RATE_HZ)
    return (torque + 0.04 * np.random.default_rng(12345).standard_normal(torque.size)).tolist()


class FakeRig:
    """Plays one test at a time; what it does wrong can be set."""

    def __init__(self, path: Path, data: Path, speed: float = 12.0, rate_hz: float = 400.0) -> None:
        self.path, self.data, self.speed, self.rate_hz = path, data, speed, rate_hz
        self.state, self.reason = "ready", ""
        self.stops = self.starts = 0
        self.stopped_by: str | None = None
        self.withdrawn: list[rig_requests.WithdrawRequest] = []
        self.plan: m.TestPlan | None = None
        self.last_plan: m.TestPlan | None = None
        """Kept when the test has ended."""
        self.score: FakeScore | None = None
        self.elapsed_s = self.duration_s = 0.0
        self.key, self.arm = "", FakeArm()
        self.calibration: m.CalibrationStatus | None = None
        self.calibrated: m.Calibrated | None = None
        self.asked: rig_requests.CalibrateStartRequest | None = None
        self.finished: m.FinishedEvent | None = None
        self.more_summary: dict[str, Any] = {}
        self.warnings: list[str] = []
        self.pauses: list[m.Pause] = []
        self.confirms_stop = self.cell_speaks = self.device_back = True
        self.mute = self.ignores_starts = self.loses_ends = self.require_calibration = False
        self.shortest_us = 20.0
        self.limits = {
            "current_ma": m.Bound(lo=0, hi=60, unit="mA", owner="rig file"),
            "pulse_width_us": m.Bound(lo=0, hi=500, unit="µs", owner="hard limit"),
            "torque_nm": m.Bound(lo=-60, hi=60, unit="N·m", owner="hard limit"),
            "charge_per_phase_uc": m.Bound(lo=0, hi=20, unit="µC", owner="rig file"),
        }
        self._stop = asyncio.Event()
        self._subscribers: set[asyncio.StreamWriter] = set()
        self._tasks: list[asyncio.Task[None]] = []

    @property
    def latch(self) -> str:
        return f"fake-{self.stops}"

    @property
    def segment(self) -> str | None:
        segments = self.score.segments if self.score else []
        return next((s["name"] for s in segments if s["start_s"] <= self.elapsed_s < s["end_s"]), None)

    def status(self) -> m.Status:
        return m.Status(
            state=self.state, reason=self.reason, latch=self.latch, calibrated=self.calibrated,
            test_id=self.plan.test_id if self.plan else None,
            participant=self.plan.participant if self.plan else None, segment=self.segment,
            elapsed_s=self.elapsed_s, duration_s=self.duration_s,
            stimulator={"device": "fake P24", "firmware": "1.0", "shortest_us": self.shortest_us},
            load_cell={"device": "fake cell", "rate_hz": 400.0},
            torque_age_s=0.004, torque_nm=0.01, calibration=self.calibration and with_next(self.calibration),
            limits=self.limits, require_calibration=self.require_calibration,
            finished=self.finished, angle=self.arm.status(self.elapsed_s),
        )  # fmt: skip

    async def serve(self) -> None:
        self.path.unlink(missing_ok=True)
        self._server = await asyncio.start_unix_server(self._client, str(self.path), limit=2**25)
        self._tasks.append(asyncio.create_task(self._speak()))

    async def close(self) -> None:
        for task in self._tasks:
            task.cancel()
        self._server.close()
        for writer in list(self._subscribers):
            writer.close()
        self.path.unlink(missing_ok=True)

    async def _speak(self) -> None:
        """What the load cell says while no test is on."""
        while True:
            await asyncio.sleep(4 * FRAME_S)
            if self.cell_speaks and not self.mute and self.state != "running":
                self._send(m.LiveEvent(
                    test_id=None, segment=None, elapsed_s=0.0, duration_s=0.0, zero_s=0.0,
                    torque=packed([(0.0, 0.42, 0), (0.001, 0.44, 1)]), torque_age_s=0.004,
                    lost_samples=0, dropped_pulses=0, **self.arm.now(time.monotonic()),
                ))  # fmt: skip

    def become(self, state: Any, reason: str = "") -> None:
        """Another state, told at once."""
        self.stops += state != "ready"
        self.state, self.reason = state, reason
        self._tell_state()

    def _tell_state(self) -> None:
        self._send(m.StateEvent(status=self.status()))

    def _send(self, event: Any) -> None:
        line = event.model_dump_json().encode() + b"\n"
        for writer in list(self._subscribers):
            with contextlib.suppress(ConnectionError, RuntimeError):
                writer.write(line)

    # ---- requests ------------------------------------------------------------------------------------------------

    async def _client(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(ConnectionError, asyncio.CancelledError):
            while line := await reader.readline():
                request = None if self.mute else REQUESTS.validate_json(line)
                if request is None or (self.ignores_starts and isinstance(request, rig_requests.StartRequest)):
                    continue
                if isinstance(request, rig_requests.SubscribeRequest):
                    self._subscribers.add(writer)
                writer.write((await self._answer(request)).model_dump_json().encode() + b"\n")
        self._subscribers.discard(writer)
        writer.close()

    async def _answer(self, request: Any) -> m.Reply:
        handler = getattr(self, f"_on_{request.kind}".replace("-", "_"), None)
        try:
            answer = None if handler is None else await handler(request)
        except Refusal as error:
            code, title, detail = error.args
            return m.Reply(id=request.id, ok=False, problem=m.Problem(code=code, title=title, detail=detail))
        return m.Reply(id=request.id, ok=True, body=(answer or self.status()).model_dump())

    async def _on_preview(self, request: Any) -> m.Preview:
        if self.state in NO_PREVIEW:
            raise Refusal("busy", "The rig is busy", "a test is in progress; look at the plan afterwards")
        widths, segments = widths_of(request.plan)
        charge = sum(widths) * request.plan.profile.current_ma / 1000
        return m.Preview(
            duration_s=len(widths) / PULSE_RATE_HZ, charge_uc=charge, torque_time_nms=None, pulse_width_us=widths,
            segments=segments,
        )  # fmt: skip

    async def _on_sequences(self, request: Any) -> m.Sequences:
        settings = {"type": "object", "properties": {"duration_s": {"type": "number", "maximum": 600}}}
        rest = m.SequenceInfo(id="rest", description="No pulses.", settings=settings)
        default = [m.SegmentPlan(name="rest", sequence="rest", settings={"duration_s": 1.0})]
        return m.Sequences(sequences=[rest], default=default)

    async def _on_start(self, request: Any) -> None:
        if self.state == "running":
            raise Refusal("busy", "A test is running", "Wait or stop it.")
        if self.state != "ready":
            raise Refusal(self.state, "The rig stands still", f"{self.reason}. Re-arm it.")
        widths_of(request.plan)
        if why := self.arm.refuses(request.plan, time.monotonic()):
            raise Refusal("refused", "Not at this angle", why)
        self.starts += 1
        self.last_plan = self.plan = request.plan
        self.state, self.reason, self.key = "running", "", request.key
        self._stop.clear()
        self._tasks.append(asyncio.create_task(self._run(request.plan)))

    async def _on_withdraw(self, request: Any) -> m.Withdrawn:
        self.withdrawn.append(request)
        plays = self.state == "running" and self.plan is not None and self.plan.test_id == request.test_id
        if plays and request.begun:
            self._stop.set()
        return m.Withdrawn(withdrawn=plays and request.begun)

    async def _on_stop(self, request: Any) -> m.StopEvidence:
        self.stopped_by = request.by
        self._stop.set()
        if self.state == "running":
            self.stops += 1
        else:
            self.become("latched", f"stopped by {request.by}")
        words = "No pulse since the stop command." if self.confirms_stop else "No ack."
        return m.StopEvidence(
            confirmed=self.confirms_stop, detail=words, last_pulse_age_s=0.06, device_state="not initialised"
        )

    async def _on_rearm(self, request: Any) -> None:
        if self.state == "running":  # as the rig does until its recording is sealed, also after a stop
            raise Refusal("busy", "Not now", "a test is running; nothing to re-arm")
        if request.latch != self.latch:
            raise Refusal("latch-changed", "It was stopped again", f"{self.reason}; look, then re-arm")
        if not self.device_back:
            words = "load cell: connected, but no torque arrives; check its cable and start frames"
            raise Refusal("disconnected", "A device does not answer", words)
        self.become("ready")

    def _adaptive(self, request: Any) -> FakeScore:
        if self.score is None or self.plan is None or self.plan.test_id != request.test_id:
            raise Refusal("late", "Too late", f"test {request.test_id!r} is not running")
        if self.score.adaptive is None:
            raise Refusal("bad-plan", "Not adaptive", f"test {request.test_id} has a fixed plan")
        return self.score

    async def _on_extend(self, request: Any) -> m.Extended:
        score = self._adaptive(request)
        if request.key != self.key:
            raise Refusal("bad-plan", "Wrong key", "extend.key: not the key")
        if request.segments and (code := score.extend(request.after, request.segments)):
            raise Refusal(code, "Not laid", f"extend: {code}")
        return m.Extended(**score.told(request.test_id))

    async def _on_enough(self, request: Any) -> m.Extended:
        score = self._adaptive(request)
        if not score.ended_by:
            score.end("enough", self.elapsed_s if request.at_once else None)
        return m.Extended(**score.told(request.test_id))

    async def _on_angle_pose(self, request: Any) -> None:
        if self.state != "ready":
            raise Refusal("busy", "Not now", f"the rig is {self.state}")
        if why := self.arm.pose(request.angle_rad, request.by, time.monotonic(), request.first):
            raise Refusal("bad-plan", "Not taken", why)

    async def _on_calibrate_start(self, request: Any) -> None:
        if self.state != "ready":
            raise Refusal("busy" if self.state == "running" else self.state, "Not now", f"the rig is {self.state}")
        self.state, self.asked = "calibrating", request
        self.calibration = m.CalibrationStatus(
            calibration_id=request.calibration_id, participant=request.participant, by=request.by,
            current_ma=request.current_ma, step_us=request.step_us, train_s=request.train_s,
            max_torque_nm=request.max_torque_nm, pulse_width_us=0.0, ceiling_us=45.0, ceiling_owner="hard limit",
            missing=["sensory", "motor", "comfort"],
        )  # fmt: skip

    def _calibrating(self) -> m.CalibrationStatus:
        assert self.calibration is not None
        return self.calibration

    async def _on_calibrate_step(self, request: Any) -> None:
        known = self._calibrating()
        steps = {"up": 1, "fine": 0.5, "down": -1, "repeat": 0}
        width_us = known.pulse_width_us + steps[request.direction] * known.step_us
        if request.shown_us not in (None, width_us):
            raise Refusal("bad-plan", "Not what was shown", f"{width_us:g} µs would be sent; nothing was sent.")
        if width_us > known.ceiling_us:
            raise Refusal("refused", "Above a limit", f"{width_us:g} µs is above the hard limit of 45 µs by 5 µs")
        train = m.CalibrationTrain(number=len(known.trains) + 1, pulse_width_us=width_us, pulses=40, torque_rise_nm=0.1)
        self.calibration = known.model_copy(update={"pulse_width_us": width_us, "trains": [*known.trains, train]})

    async def _on_calibrate_mark(self, request: Any) -> None:
        known = self._calibrating()
        if not known.trains:
            raise Refusal("bad-plan", "Nothing was played yet", "Step up first, then mark.")
        marks = {**known.marks_us, request.threshold: known.pulse_width_us}
        missing = [name for name in known.missing if name not in marks]
        self.calibration = known.model_copy(update={"marks_us": marks, "missing": missing})

    async def _on_calibrate_finish(self, request: Any) -> m.CalibrationResult:
        kept = self.calibrated
        if kept is not None and request.calibration_id == kept.calibration_id:
            self.calibrated = None if request.discard else kept
            return m.CalibrationResult() if request.discard else kept.result
        known = self._calibrating()
        if known.missing and not request.discard:
            raise Refusal("bad-plan", "Not marked yet", f"not marked yet: {', '.join(known.missing)}")
        self.state, self.calibration = "ready", None
        if request.discard:
            return m.CalibrationResult()
        profile = m.Profile(
            current_ma=known.current_ma, max_pulse_width_us=known.marks_us["comfort"],
            max_torque_nm=known.max_torque_nm, sensory_pulse_width_us=known.marks_us["sensory"],
            motor_pulse_width_us=known.marks_us["motor"],
            set_at_utc="2026-01-01T08:00:00Z", expires_at_utc="2999-01-02T00:00:00Z",
        )  # fmt: skip
        result = m.CalibrationResult(profile=profile, recordings=["C1.001"])
        self.calibrated = m.Calibrated(
            calibration_id=known.calibration_id, participant=known.participant, by=known.by, result=result
        )
        return result

    async def _on_calibrate_stored(self, request: Any) -> None:
        self.calibrated = None

    # ---- a test --------------------------------------------------------------------------------------------------

    async def _run(self, plan: m.TestPlan) -> None:
        try:
            await self._play(plan)
        except Exception as error:  # a test never goes on for ever, whatever is wrong in here
            traceback.print_exc()
            self.state, self.reason, self.plan, self.score = "latched", f"fake rig: {error!r}", None, None
            self._tell_state()
            self._send(
                m.FinishedEvent(test_id=plan.test_id, outcome="fault", reason=self.reason, last_sample_unix_s=None)
            )

    async def _play(self, plan: m.TestPlan) -> None:
        self.score = score = FakeScore(plan, *(widths_of(plan) if plan.adaptive is None else default_widths()))
        torque = muscle(score.widths, self.rate_hz)
        self.duration_s = plan.adaptive.max_duration_s if plan.adaptive else score.end_s
        self._tell_state()
        began, sent = time.monotonic(), 0.0
        while sent < score.end_s and not self._stop.is_set():
            await asyncio.sleep(FRAME_S)
            now_s = (time.monotonic() - began) * self.speed
            score.go_on(now_s)
            if len(torque) != round(score.end_s * self.rate_hz):
                torque = muscle(score.widths, self.rate_hz)
            until = self.elapsed_s = min(score.end_s, now_s)
            self._send(self._frame(plan, score, torque, sent, until))
            sent = until
        self._end(plan, score, score.widths[: round(sent * PULSE_RATE_HZ)], torque[: round(sent * self.rate_hz)])

    def _frame(self, plan: m.TestPlan, score: FakeScore, torque: list[float], start: float, end: float) -> m.LiveEvent:
        counter = range(round(start * self.rate_hz), round(end * self.rate_hz))
        first, last = round(start * PULSE_RATE_HZ), round(end * PULSE_RATE_HZ)
        widths = score.widths[:last]
        return m.LiveEvent(
            test_id=plan.test_id, segment=self.segment, elapsed_s=end, duration_s=self.duration_s, zero_s=ZERO_S,
            torque=packed([(ZERO_S + k / self.rate_hz + 0.0005 * (k % 3), torque[k], k) for k in counter]),
            pulse_rate_hz=PULSE_RATE_HZ, torque_age_s=0.004, lost_samples=0, dropped_pulses=0,
            sent_pulses=sum(1 for width in widths if width),
            charge_uc=sum(widths) * plan.profile.current_ma / 1000, **score.live(),
            torque_time_nms=sum(map(abs, torque[: counter.stop])) / self.rate_hz,
            outcomes=outcomes(widths, first), pauses=self.pauses, **self.arm.live(start, end),
        )  # fmt: skip

    def _end(self, plan: m.TestPlan, score: FakeScore, widths: list[float], torque: list[float]) -> None:
        stopped = self._stop.is_set()
        outcome = "stopped" if stopped else "completed"
        path, digest = write_recording(self.data, plan, widths, torque, score.segments, self.rate_hz, outcome)
        self.state, self.reason = ("latched", f"stopped by {self.stopped_by}") if stopped else ("ready", "")
        self.plan = self.score = None
        self._tell_state()
        if self.loses_ends:
            return
        self.finished = m.FinishedEvent(
            test_id=plan.test_id, outcome=outcome, reason=self.reason, recording_path=str(path),
            recording_id=path.stem, file_sha256=digest, last_sample_unix_s=time.time(),
            summary={
                "duration_s": len(widths) / PULSE_RATE_HZ, "samples": len(torque), "lost_samples": 0,
                "pulses": sum(1 for w in widths if w), "dropped_pulses": 0,
                "lateness_ms": {"median": 0.08, "p99": 0.12, "max": 0.3}, "charge_uc": sum(widths) * 20 / 1000,
                "alignment": {"method": "sync", "error_ms": 0.02}, "sample_rate_hz": self.rate_hz,
                "torque_peak_nm": max(torque, default=0.0), "cpu_percent": 3.0, "warnings": self.warnings,
                "notes": [STOPPED] * len(self.pauses[:1]),
                "ended_by": "stopped" if stopped else score.ended_by,
                **self.more_summary,
            },
        )  # fmt: skip
        self._send(self.finished)


def packed(rows: list[tuple[float, float, int]]) -> str:
    """Host time, torque and counter of samples as a live event carries them."""
    return b64encode(b"".join(m.TORQUE_ROW.pack(s, nan, nm, k, 255) for s, nm, k in rows)).decode()


def outcomes(widths: list[float], first: int) -> m.PulseOutcomes:
    """Each pulse since the first was sent and acknowledged in time, or is a rest."""
    index, sent = range(first, len(widths)), widths[first:]
    due = [k / PULSE_RATE_HZ if width else None for k, width in zip(index, sent, strict=True)]
    return m.PulseOutcomes(
        index=list(index), pulse_width_us=sent, written_time_s=due,
        acknowledged_time_s=[s and s + 0.001 for s in due], status=[0 if width else 1 for width in sent],
    )  # fmt: skip


def with_next(known: m.CalibrationStatus) -> m.CalibrationStatus:
    """With the widths that each step would send."""
    widths = {"up": known.pulse_width_us + known.step_us, "fine": known.pulse_width_us + known.step_us / 2}
    if known.trains:
        widths |= {"repeat": known.pulse_width_us, "down": known.pulse_width_us - known.step_us}
    allowed = {name: width for name, width in widths.items() if 1 <= width <= known.ceiling_us}
    return m.CalibrationStatus.model_validate({**known.model_dump(), "next_us": allowed})


def write_recording(folder: Path, plan: m.TestPlan, widths: list[float], torque: list[float], segments: Any,
                    rate_hz: float, outcome: str) -> tuple[Path, str]:  # fmt: skip
    """A recording as the rig seals it, and the SHA-256 of its file."""
    count, pulses, end = len(torque), len(widths), len(widths) / PULSE_RATE_HZ
    time_s, due, sent = np.arange(count) / rate_hz, np.arange(pulses) / PULSE_RATE_HZ, np.asarray(widths, float)
    kept = [s for s in segments if s["start_s"] < end]
    columns = {
        "torque/time_s": time_s, "torque/torque_nm": np.asarray(torque, float), "torque/counter": np.arange(count),
        "torque/host_time_s": time_s + 0.002, "torque/sync": np.zeros(count, "u1"),
        "torque/gaps": np.zeros((0, 2), "i8"), "pulses/planned_time_s": due, "pulses/pulse_width_us": sent,
        "pulses/sent_pulse_width_us": sent, "pulses/current_ma": np.where(sent > 0, 20.0, 0.0),
        "pulses/written_time_s": due, "pulses/acknowledged_time_s": due + 0.001,
        "pulses/status": np.where(sent > 0, 0, 1).astype("u1"),
        "segments/start_s": np.array([s["start_s"] for s in kept]),
        "segments/end_s": np.array([min(s["end_s"], end) for s in kept]),
    }  # fmt: skip
    attributes = {
        "format": "stimrig-recording", "format_version": 1, "recording_id": f"R-{plan.test_id}",
        "test_id": plan.test_id, "participant": plan.participant, "kind": plan.kind,
        "created_utc": "2026-01-01T00:00:00Z", "outcome": outcome, "reason": "", "software": "fake rig",
        "configuration": "{}", "pulse_rate_hz": PULSE_RATE_HZ, "sample_rate_hz": rate_hz,
        "sample_rate_measured_hz": rate_hz, "current_ma": 20.0,
    }  # fmt: skip
    recording = Recording(columns, [s["name"] for s in kept], attributes, Alignment("sync", 0.02, 0.0, 0.0))
    data, path = archive.to_bytes(recording), folder / f"R-{plan.test_id}.h5"
    folder.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    return path, hashlib.sha256(data).hexdigest()


class RigThread:
    """A fake rig in a thread with a loop of its own."""

    def __init__(self, path: Path, data: Path, **settings: Any) -> None:
        self.path, self.data, self.settings = path, data, settings
        self.rig: FakeRig

    def __enter__(self) -> RigThread:
        self.loop = asyncio.new_event_loop()
        self.thread = threading.Thread(target=self.loop.run_forever, daemon=True)
        self.thread.start()
        self._run(self._begin())
        return self

    async def _begin(self) -> None:
        self.rig = FakeRig(self.path, self.data, **self.settings)
        await self.rig.serve()

    def _run(self, work: Any) -> None:
        asyncio.run_coroutine_threadsafe(work, self.loop).result(60)

    def become(self, state: str, reason: str = "") -> None:
        """Another state of the rig, from another thread; it is that when this returns."""

        async def become() -> None:
            self.rig.become(state, reason)

        self._run(become())

    def cut_link(self) -> None:
        """The lasting connection breaks; a new one is taken."""

        async def cut() -> None:
            for writer in list(self.rig._subscribers):
                writer.close()

        self._run(cut())

    def __exit__(self, *_: object) -> None:
        if self.thread.is_alive():
            self._run(self.rig.close())
            self.loop.call_soon_threadsafe(self.loop.stop)
            self.thread.join(5)
