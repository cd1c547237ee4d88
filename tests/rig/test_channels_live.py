"""A whole rig with two channels: start, status, live events, calibration of both in one go, a crash."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import h5py
import pytest

from stimrig.rig import journal
from stimrig.rig.control.replies import previewed
from stimrig.rig.errors import PlanError, RefusedError, RigError
from stimrig.rig.limits import SUM_LIMITS
from stimrig.rig.messages import AdaptivePlan, CalibrationResult, ChannelPlan
from stimrig.rig.requests import CalibrateFinishRequest, CalibrateStartRequest, ExtendRequest, PreviewRequest
from tests.rig.fakes import hold
from tests.rig.live import LiveRig
from tests.rig.test_channels import BICEPS, TRICEPS, both, on_both, part

Make = Callable[..., LiveRig]
CHANNELS = [
    {"name": "biceps", "muscle": "m. biceps brachii", "side": "right", "electrode": "5 x 5 cm", "channel": 1},
    {"name": "triceps", "muscle": "m. triceps brachii", "side": "right", "electrode": "5 x 9 cm", "channel": 2},
]
NAMES = [{name: one[name] for name in ("name", "muscle", "side", "electrode")} for one in CHANNELS]


def of_both(test_id: str = "t1", **more: Any) -> dict[str, Any]:
    return {"test_id": test_id, "profile": BICEPS, "channels": both(), "segments": [on_both()], **more}


class TestTests:
    def test_from_start_to_recording(self, make: Make) -> None:
        live = make(channels=CHANNELS)
        status = live.rig.status()
        assert status.stimulator["channels"] == NAMES
        assert {"all_charge_per_second_uc", "channel_gap_s"} <= set(status.limits)
        live.start(live.plan(**of_both()))
        live.wait_pulses(21)
        event = live.event(samples=True)
        assert event is not None
        assert event.channels is not None
        assert event.outcomes is not None
        assert [one.name for one in event.channels] == ["biceps", "triceps"]
        assert event.outcomes.channel == [index % 2 for index in event.outcomes.index]
        for place, one in enumerate(event.channels):
            own = [t for t, c in zip(event.pulse_time_s, event.outcomes.channel, strict=True) if c == place]
            assert one.pulse_time_s == own
        assert sum(one.sent_pulses for one in event.channels) == event.sent_pulses
        assert sum(one.charge_uc for one in event.channels) == pytest.approx(event.charge_uc)
        live.wait("ready")
        summary = live.finished.summary
        assert {name: of["pulses"] for name, of in summary["channels"].items()} == {"biceps": 40, "triceps": 40}
        with h5py.File(str(live.finished.recording_path)) as file:
            assert [one["name"] for one in json.loads(file.attrs["channels"])] == ["biceps", "triceps"]
            assert [one["muscle"] for one in json.loads(file.attrs["channels"])] == [n["muscle"] for n in NAMES]

    def test_one_channel_sees_nothing_of_it(self, make: Make) -> None:
        live = make()
        told = live.rig.status().model_dump_json()
        live.start(live.plan("t1"))
        live.wait_pulses(5)
        event = live.event(samples=True)
        assert event is not None
        live.wait("ready")
        for words in (told, event.model_dump_json(), live.finished.model_dump_json()):
            assert '"channel' not in words
            assert "profiles" not in words
        assert not set(SUM_LIMITS) & set(live.rig.status().limits)

    def test_a_channel_that_the_rig_does_not_have(self, make: Make) -> None:
        live = make(channels=CHANNELS)
        chosen = [ChannelPlan(name="deltoid", profile=BICEPS)]
        with pytest.raises(PlanError, match="no channel 'deltoid'; this rig has biceps, triceps"):
            live.start(live.plan(**of_both(channels=chosen)))
        live.close()
        with pytest.raises(RigError, match="leave channels out"):
            make().start(live.plan(**of_both()))

    def test_each_channels_calibration_is_checked(self, make: Make) -> None:
        live = make(channels=CHANNELS)
        old = {"sensory_pulse_width_us": 50.0, "motor_pulse_width_us": 80.0, "set_at_utc": "2020-01-01T00:00:00Z"}
        stale = TRICEPS.model_copy(update={**old, "expires_at_utc": "2020-01-01T12:00:00Z"})
        with pytest.raises(RefusedError, match="channel triceps: participant's profile: expired"):
            live.start(live.plan(**of_both(channels=both(profile=stale))))
        live.close()
        strict = make(channels=CHANNELS, require_calibration=True)
        with pytest.raises(RefusedError, match="not calibrated"):
            strict.start(strict.plan(**of_both("t2")))

    def test_rest_is_between_tests_of_other_channels(self, make: Make) -> None:
        """The muscle is another one, the joint is not."""
        live = make(channels=CHANNELS)
        alone = [ChannelPlan(name="triceps", profile=TRICEPS)]
        live.play(**of_both("t1", segments=[on_both()]))
        with pytest.raises(RigError, match="rest_between_tests_s"):
            live.start(live.plan("t2", profile=TRICEPS, channels=alone, segments=[hold()]))

    def test_a_crash(self, make: Make) -> None:
        live = make(channels=CHANNELS)
        live.start(live.plan(**of_both()))
        live.wait_pulses(31)
        path = live.config.data_dir / "journals" / "t1.journal"
        sent = [(p.output, p.charge_uc) for _, p in live.stimulator.sent]
        data = path.read_bytes()
        live.close()
        for recording in (live.config.data_dir / "recordings").iterdir():
            recording.unlink()
        path.write_bytes(data)
        again = make(channels=CHANNELS)
        summary = again.finished.summary
        for place, name in enumerate(("biceps", "triceps")):
            own_uc = sum(uc for output, uc in sent if output == place)
            assert summary["channels"][name]["charge_uc"] == pytest.approx(own_uc)
        assert summary["charge_uc"] == pytest.approx(sum(uc for _, uc in sent))
        assert again.rig.status().state == "uncertain"
        assert journal.parse(path, data).damaged_bytes == 0

    def test_preview(self, make: Make) -> None:
        live = make(channels=CHANNELS)
        request = PreviewRequest(plan=live.plan(**of_both()))
        shown = previewed(request, live.rig.table, 0.0, rig=live.rig.channels)
        assert shown.channels is not None
        assert list(shown.channels) == ["biceps", "triceps"]

    def test_an_adaptive_one(self, make: Make) -> None:
        live = make(channels=CHANNELS)
        bounds = AdaptivePlan(max_duration_s=10.0, max_torque_time_nms=100.0)
        live.start(live.plan(**of_both(adaptive=bounds)), "k" * 16)
        more = hold("more", on_s=0.25).model_copy(update={"channels": {"triceps": part(on_s=0.5)}})
        request = ExtendRequest(test_id="t1", key="k" * 16, after=80, segments=[more])
        told = live.ask(live.rig.player.extend(request))
        assert (told.laid, told.boundary_s) == (120, pytest.approx(1.5))
        live.wait("ready")
        assert live.finished.summary["channels"]["triceps"]["pulses"] == 60


def begun(live: LiveRig, **more: Any) -> None:
    of = [{"name": "biceps"}, {"name": "triceps", "current_ma": 10.0, "max_pulse_width_us": 60.0}]
    request = {"calibration_id": "c1", "participant": "P", "by": "nurse", "step_us": 20.0, "train_s": 0.5}
    given = CalibrateStartRequest.model_validate({**request, "channels": of, **more})
    live.ask(live.rig.calibrations.start(given))


def step(live: LiveRig, channel: str, direction: Any = "up") -> None:
    live.step(direction, channel)
    live.wait("calibrating")
    live.clock.wait(live.machine.tasks, 0.5)


class TestCalibration:
    def test_both_in_one_go(self, make: Make) -> None:
        live = make(channels=CHANNELS)
        begun(live)
        for channel in ("biceps", "triceps"):
            for mark in ("sensory", "motor", "comfort"):
                step(live, channel)
                live.mark(mark, channel)  # type: ignore[arg-type]
        status = live.rig.status().calibration
        assert status is not None
        assert status.channels is not None
        assert [one.name for one in status.channels] == ["biceps", "triceps"]
        assert [one.marks_us["comfort"] for one in status.channels] == [60.0, 60.0]
        assert [train.channel for train in status.trains] == ["biceps"] * 3 + ["triceps"] * 3
        assert [train.number for train in status.trains] == [1, 2, 3, 4, 5, 6]
        outputs = [(p.output, p.pulse_width_us, p.current_ma) for _, p in live.stimulator.sent[::20]]
        assert outputs == [(0, w, 20.0) for w in (20, 40, 60)] + [(1, w, 10.0) for w in (20, 40, 60)]
        result = self._finish(live)
        assert result.profiles is not None
        assert result.profile == result.profiles["biceps"]
        assert (result.profiles["triceps"].current_ma, result.profiles["triceps"].max_pulse_width_us) == (10.0, 60.0)
        assert len(result.recordings) == 6
        waits = live.rig.status().calibrated
        assert waits is not None
        assert waits.result == result

    def test_every_threshold_of_every_channel(self, make: Make) -> None:
        live = make(channels=CHANNELS)
        begun(live)
        for mark in ("sensory", "motor", "comfort"):
            step(live, "biceps")
            live.mark(mark, "biceps")  # type: ignore[arg-type]
        with pytest.raises(PlanError, match="channel triceps: calibration: not marked yet: sensory, motor, comfort"):
            self._finish(live)
        assert live.rig.status().state == "calibrating"

    def test_each_begins_at_its_first_step(self, make: Make) -> None:
        """What one muscle bears says nothing of the other: its trains begin small."""
        live = make(channels=CHANNELS)
        begun(live)
        for _ in range(5):
            step(live, "biceps")
        step(live, "triceps")
        assert [live.stimulator.sent[at][1].pulse_width_us for at in (-21, -1)] == [100, 20]

    @pytest.mark.parametrize("channel", ["", "deltoid"])
    def test_a_step_names_its_channel(self, make: Make, channel: str) -> None:
        live = make(channels=CHANNELS)
        begun(live)
        with pytest.raises(PlanError, match=r"is not calibrated \(biceps, triceps\)"):
            step(live, channel)
        step(live, "biceps")
        with pytest.raises(PlanError, match="is not calibrated"):
            live.mark("sensory", channel)
        with pytest.raises(PlanError, match="no train was played yet"):
            live.mark("sensory", "triceps")

    @pytest.mark.parametrize(
        ("channels", "words"),
        [
            ([{"name": "deltoid"}], "no channel 'deltoid'"),
            ([{"name": "biceps"}, {"name": "biceps"}], "given twice"),
            ([{"name": "biceps", "current_ma": 200.0}], "current_ma 200"),
        ],
    )
    def test_wrong_channels(self, make: Make, channels: list[dict[str, Any]], words: str) -> None:
        live = make(channels=CHANNELS)
        with pytest.raises(RigError, match=words):
            begun(live, channels=channels)

    def test_the_ceiling_is_of_the_channel(self, make: Make) -> None:
        tight = [CHANNELS[0], {**CHANNELS[1], "limits": {"pulse_width_us": 40.0}}]
        live = make(channels=tight)
        begun(live)
        status = live.rig.status().calibration
        assert status is not None
        assert status.channels is not None
        assert [one.ceiling_us for one in status.channels] == [500.0, 40.0]
        for _ in range(2):
            step(live, "triceps")
        with pytest.raises(RefusedError, match="rig file, triceps"):
            step(live, "triceps")

    def test_all_channels_share_a_dose(self, make: Make) -> None:
        live = make(channels=CHANNELS)
        live.rig.table["all_charge_per_test_uc"] = SUM_LIMITS["all_charge_per_test_uc"].__class__(
            "all_charge_per_test_uc", 0.0, 11.0, "µC", "", "", "hard limit"
        )
        begun(live)
        step(live, "biceps")  # 20 pulses of 0.4 µC
        with pytest.raises(RefusedError, match="calibration, all channels together"):
            step(live, "triceps")

    @staticmethod
    def _finish(live: LiveRig) -> CalibrationResult:
        return live.ask(live.rig.calibrations.finish(CalibrateFinishRequest(by="nurse")))
