"""Tests of several channels: slots, limits of each and of all, one pulse on the line at a time, journal, recording."""

from __future__ import annotations

import io
import itertools
import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stimrig.rig import archive, assembly, channels, journal, limits, plan
from stimrig.rig.acquire.run import RunResult
from stimrig.rig.channels import RigChannel
from stimrig.rig.errors import PlanError, RigError
from stimrig.rig.journal import Intent, Kind
from stimrig.rig.limits import HARD_LIMITS, LONGEST_PULSE_S, SUM_LIMITS, Limit
from stimrig.rig.messages import AdaptivePlan, ChannelPlan, ChannelSequence, Profile, SegmentPlan, TestPlan
from stimrig.rig.signals import Pulse, PulseStatus
from stimrig.rig.train import Train, train_of
from tests.rig.fakes import VirtualRig, extend, hold, rest, void

BASE = {**HARD_LIMITS, **SUM_LIMITS}
RIG = (
    RigChannel("biceps", "m. biceps brachii", "right", "5 x 5 cm"),
    RigChannel("triceps", "m. triceps brachii", "right", "5 x 9 cm"),
)
BICEPS, TRICEPS = Profile(current_ma=20.0, max_pulse_width_us=300.0), Profile(current_ma=30.0, max_pulse_width_us=200.0)


def both(**of_triceps: Any) -> list[ChannelPlan]:
    return [
        ChannelPlan(name="biceps", profile=BICEPS),
        ChannelPlan(name="triceps", **{"profile": TRICEPS, **of_triceps}),
    ]


def part(sequence: str = "steps", **more: Any) -> ChannelSequence:
    default = {"on_s": 1.0, "off_s": 0.0, "repeats": 1} if sequence == "steps" else {}
    return ChannelSequence(sequence=sequence, settings={**default, **more})


def on_both(**of_triceps: Any) -> SegmentPlan:
    """A second on both channels at their widest."""
    return hold("both").model_copy(update={"channels": {"triceps": part(**of_triceps)}})


def two(folder: Path, segments: list[SegmentPlan] | None = None, **more: Any) -> VirtualRig:
    segments = segments or [rest(0.5), on_both(), rest(0.5)]
    return VirtualRig(folder, segments, **{"base": BASE, "channels": both(), "rig": RIG, **more})


def planned(segments: list[SegmentPlan], base: dict[str, Limit] = BASE, **more: Any) -> plan.PlannedTest:
    given = {"test_id": "t", "participant": "P", "profile": BICEPS, "segments": segments, "channels": both(), **more}
    request = TestPlan(**given)
    return plan.build(request, limits.for_plan(base, request), RIG)


def refused(action: Callable[[], object], *words: str) -> None:
    with pytest.raises(RigError) as told:
        action()
    assert all(word in str(told.value) for word in words), told.value


class TestTrain:
    @given(
        rate_hz=st.floats(1.0, 60.0),
        shares=st.lists(st.floats(0.01, 0.99), max_size=7, unique=True).map(sorted),
        slot=st.integers(0, 20_000),
    )
    def test_slots(self, rate_hz: float, shares: list[float], slot: int) -> None:
        train = train_of(rate_hz, [0.0, *(share / rate_hz for share in shares)])
        count = len(shares) + 1
        assert train.channel(slot) == slot % count
        assert train.due_s(slot) == pytest.approx((slot // count) / rate_hz + train.offsets_s[slot % count])
        assert train.due_s(slot + 1) - train.due_s(slot) == pytest.approx(train.gap_s(slot % count), abs=1e-9)
        assert train.due_times_s(slot % 50 + 1)[-1] == train.due_s(slot % 50)
        assert train.whole(slot) % count == 0
        assert 0 <= train.whole(slot) - slot < count

    def test_channels_share_the_period(self) -> None:
        assert train_of(40.0, [None] * 4).offsets_s == (0.0, 0.00625, 0.0125, 0.01875)

    def test_one_channel_is_as_ever(self) -> None:
        train = Train(40.0)
        np.testing.assert_array_equal(train.due_times_s(2000), np.arange(2000) / 40.0)
        assert (train.length_s(77), train.whole(77), train.slots(1.0)) == (77 / 40.0, 77, 40)


class TestPlans:
    def test_each_plays_its_own_and_rests_elsewhere(self) -> None:
        chosen = [
            rest(0.1),
            on_both(on_s=0.05).model_copy(update={"name": "unequal"}),
            hold("first", on_s=0.05),
            SegmentPlan(name="second", sequence="rest", settings={"duration_s": 0.05}, channels={"triceps": part()}),
        ]
        test = planned(chosen)
        first_us, second_us = test.pulse_width_us[::2], test.pulse_width_us[1::2]
        np.testing.assert_array_equal(first_us, [0.0] * 4 + [300.0] * 40 + [300.0] * 2 + [0.0] * 40)
        np.testing.assert_array_equal(second_us, [0.0] * 4 + [200.0] * 2 + [0.0] * 38 + [0.0] * 2 + [200.0] * 40)
        assert test.duration_s == pytest.approx(86 / 40)
        assert [(s.start, s.end) for s in test.segments] == [(0, 8), (8, 88), (88, 92), (92, 172)]
        assert test.charge_uc == pytest.approx(42 * 6.0 + 42 * 6.0)

    def test_the_default_test_plays_each_channel_alone_and_all_together(self) -> None:
        request = TestPlan(test_id="t", participant="P", profile=BICEPS, channels=both())
        test = plan.build(request, limits.for_plan(BASE, request), RIG)
        biceps, triceps = test.pulse_width_us.reshape(-1, 2).T > 0
        assert test.duration_s < 1.5 * 38.75
        for rows in (biceps & ~triceps, triceps & ~biceps, biceps & triceps):
            assert rows.sum() > 3 * 40
        assert abs(np.corrcoef(*test.pulse_width_us.reshape(-1, 2).T)[0, 1]) < 0.2
        paper = request.model_copy(update={"protocol": "paper", "channels": None})
        alone = plan.build(paper, limits.for_plan(BASE, paper), RIG)
        own_us = test.pulse_width_us.reshape(-1, 2).sum(axis=0)
        most_us = 1.3 * alone.pulse_width_us.sum() * np.array([1.0, both()[1].profile.max_pulse_width_us / 300.0])
        assert np.all(own_us <= most_us)
        short = request.model_copy(update={"protocol": "short"})
        with pytest.raises(PlanError, match="is for one channel"):
            plan.build(short, limits.for_plan(BASE, short), RIG)

    @pytest.mark.parametrize(
        ("chosen", "words"),
        [
            ([ChannelPlan(name="deltoid", profile=BICEPS)], ["'deltoid'", "biceps, triceps"]),
            ([*both(), both()[1]], ["'triceps' is given twice"]),
            (both(offset_s=0.0), ["channel_gap_s 0 s"]),
            (both(offset_s=0.001), ["channel_gap_s 0.001 s"]),
            (both(offset_s=0.0245), ["channel_gap_s 0.0005 s"]),
            (both(offset_s=0.03), ["channel_gap_s"]),
            (both(offset_s=math.nan), ["channel_gap_s nan s"]),
            ([both()[0].model_copy(update={"offset_s": 0.001}), both()[1]], ["offset_s of the first channel is 0"]),
            ([both()[1]], ["plan.profile", "triceps"]),
        ],
    )
    def test_wrong_channels_are_refused(self, chosen: list[ChannelPlan], words: list[str]) -> None:
        refused(lambda: planned([on_both()], channels=chosen), *words)

    def test_a_rig_without_names_has_none(self) -> None:
        request = TestPlan(test_id="t", participant="P", profile=BICEPS, channels=both())
        refused(lambda: plan.build(request, limits.for_plan(BASE, request)), "this rig's channel has no name")

    def test_a_segment_of_a_channel_that_does_not_play(self) -> None:
        wrong = hold().model_copy(update={"channels": {"deltoid": part()}})
        refused(lambda: planned([wrong]), "segment 1 (hold)", "'deltoid'", "biceps, triceps")

    def test_every_row_holds_for_each_channel(self) -> None:
        """Also where the other channel's own is wider."""
        jump = part("ramp", up_s=0.1, down_s=0.1)
        steep = rest(0.2).model_copy(update={"channels": {"triceps": jump}})
        tight = {name: replace(BASE[name], hi=hi) for name, hi in (("width_rise_us", 40.0),)}
        wide = on_both(max_pulse_width_us=200.5)
        for chosen, base, words in (
            ([wide], BASE, ["of channel triceps: pulse_width_us 200.5", "profile of triceps"]),
            ([on_both(max_pulse_width_us=math.nan)], BASE, ["max_pulse_width_us"]),
            ([rest(0.1), steep], {**BASE, **tight}, ["of channel triceps: width_rise_us 50"]),
        ):
            refused(lambda chosen=chosen, base=base: planned(chosen, base), *words)
        for row, hi, words in (
            ("current_ma", 25.0, ["of channel triceps: current_ma 30", "hard limit"]),
            ("charge_per_phase_uc", 5.0, ["charge_per_phase_uc 6"]),
            ("charge_per_second_uc", 239.0, ["of channel biceps: charge_per_second_uc 240"]),
            ("charge_per_test_uc", 239.0, ["of channel biceps: charge_per_test_uc 240"]),
        ):
            narrow = {**BASE, row: replace(BASE[row], hi=hi)}
            refused(lambda narrow=narrow: planned([on_both()], narrow), *words)

    @pytest.mark.parametrize(
        ("row", "hi", "value"),
        [
            ("all_charge_per_second_uc", 479.0, "480"),
            ("all_charge_per_test_uc", 479.0, "480"),
            ("simultaneous_current_ma", 29.5, "30"),
        ],
    )
    def test_the_sum_has_its_own(self, row: str, hi: float, value: str) -> None:
        planned([on_both()], {**BASE, row: replace(BASE[row], hi=float(value))})
        refused(lambda: planned([on_both()], {**BASE, row: replace(BASE[row], hi=hi)}), f"plan: {row} {value}")

    def test_limits_of_a_channel_by_the_rig_file(self) -> None:
        tighter = (RIG[0], replace(RIG[1], limits={"charge_per_phase_uc": 5.0}))
        request = TestPlan(test_id="t", participant="P", profile=BICEPS, channels=both(), segments=[on_both()])
        refused(lambda: plan.build(request, limits.for_plan(BASE, request), tighter), "rig file, triceps", "over by 1)")
        alone = TestPlan(test_id="t", participant="P", profile=BICEPS, segments=[hold()])
        first = (replace(RIG[0], limits={"current_ma": 10.0}), RIG[1])
        refused(lambda: plan.build(alone, limits.for_plan(BASE, alone), first), "rig file, biceps", "current_ma 20")

    def test_torque_and_rest_are_of_the_tightest(self) -> None:
        gentle = TRICEPS.model_copy(update={"max_torque_nm": 5.0, "rest_between_tests_s": 30.0})
        request = TestPlan(test_id="t", participant="P", profile=BICEPS, channels=both(profile=gentle))
        table = limits.for_plan(BASE, request)
        assert (table["torque_nm"].hi, table["rest_between_tests_s"].lo) == (5.0, 30.0)
        assert table["torque_nm"].owner == "profile of triceps"

    @pytest.mark.parametrize("bad", [math.nan, -1.0])
    def test_no_number_is_refused(self, bad: float) -> None:
        wrong = both(profile=TRICEPS.model_copy(update={"max_pulse_width_us": bad}))
        refused(lambda: planned([on_both()], channels=wrong), "profile of triceps: pulse_width_us")
        narrow = both(max_pulse_width_us=bad)
        refused(lambda: planned([on_both()], channels=narrow), "request: pulse_width_us")

    def test_preview(self) -> None:
        shown = plan.preview(planned([on_both()]))
        assert shown.channels is not None
        assert (shown.duration_s, shown.charge_uc, len(shown.pulse_width_us)) == (1.0, pytest.approx(480.0), 80)
        triceps = shown.channels["triceps"]
        assert triceps.pulse_time_s[:2] == pytest.approx([0.0125, 0.0375])
        assert triceps.pulse_width_us == [200.0] * 40
        assert shown.segments == [{"name": "both", "start_s": 0.0, "end_s": 1.0}]


def felt_s(rig: VirtualRig) -> list[tuple[float, float, int]]:
    """When each pulse was written and acknowledged, and its output."""
    return [(s, a, p.output) for (s, p), a in zip(rig.stimulator.sent, rig.stimulator.acked_s, strict=True)]


class TestRuns:
    def test_every_pulse_at_its_time_on_its_output(self, tmp_path: Path) -> None:
        rig = two(tmp_path)
        result = rig.execute()
        assert result.outcome == "completed", result.reason
        t0_s = rig.run.t0_s
        assert t0_s is not None
        due_s = [0.5 + i / 40 + c * 0.0125 for i in range(40) for c in range(2)]
        sent = rig.stimulator.sent
        np.testing.assert_allclose([s - t0_s for s, _ in sent], due_s, atol=1e-3)
        assert [(p.output, p.pulse_width_us, p.current_ma) for _, p in sent] == [(0, 300, 20.0), (1, 200, 30.0)] * 40
        for (_, acked_s, _), (written_s, _, _) in itertools.pairwise(felt_s(rig)):
            assert written_s - acked_s >= SUM_LIMITS["channel_gap_s"].lo
        assert result.summary["channels"] == {
            "biceps": {"charge_uc": pytest.approx(240.0), "pulses": 40, "dropped_pulses": 0},
            "triceps": {"charge_uc": pytest.approx(240.0), "pulses": 40, "dropped_pulses": 0},
        }

    @settings(max_examples=25, deadline=None)
    @given(delays_s=st.lists(st.floats(0.0002, 0.05), min_size=5, max_size=40), offset_s=st.floats(0.003, 0.02))
    def test_one_is_on_its_way_and_none_overlap(
        self, tmp_path_factory: pytest.TempPathFactory, delays_s: list[float], offset_s: float
    ) -> None:
        """Whatever the line does: no pulse before the last is acknowledged, nor so soon after it that they overlap."""
        rig = two(tmp_path_factory.mktemp("t"), [rest(0.2), on_both(), rest(0.2)], channels=both(offset_s=offset_s))
        delays = itertools.cycle(delays_s)

        def next_delay(_: int) -> None:
            rig.stimulator.ack_delay_s = next(delays)

        rig.stimulator.on_send = next_delay
        result = rig.execute()
        assert result.outcome == "completed", result.reason
        assert len(rig.stimulator.sent) >= 10
        for (_, acked_s, one), (written_s, _, other) in itertools.pairwise(felt_s(rig)):
            assert written_s >= acked_s + (0.008 if one == other else LONGEST_PULSE_S)
        for output in (0, 1):
            own = [(s, a) for s, a, o in felt_s(rig) if o == output]
            assert all(later[0] - earlier[1] >= 0.008 - 1e-9 for earlier, later in itertools.pairwise(own))
        dropped = {name: of["dropped_pulses"] for name, of in result.summary["channels"].items()}
        assert sum(dropped.values()) == 80 - len(rig.stimulator.sent) == result.summary["dropped_pulses"]

    def test_a_stalled_line_holds_one_pulse_of_all_channels(self, tmp_path: Path) -> None:
        rig = two(tmp_path)
        rig.stimulator.ack_delay_s = 0.09
        result = rig.execute()
        assert result.outcome == "completed"
        for (_, acked_s, _), (written_s, _, _) in itertools.pairwise(felt_s(rig)):
            assert written_s >= acked_s

    @pytest.mark.parametrize(
        ("since", "fault", "words"),
        [
            (1, {"error": "electrode error"}, "electrode error"),
            (2, {"says_output": lambda _: 0}, "acknowledged a pulse of channel biceps instead"),
            (2, {"says_output": lambda _: -1}, "acknowledged a pulse of an output that is not in use instead"),
        ],
    )
    def test_a_fault_names_its_channel(self, tmp_path: Path, since: int, fault: dict[str, Any], words: str) -> None:
        rig = two(tmp_path)
        rig.stimulator.on_send = lambda n: vars(rig.stimulator).update(fault) if n == since else None
        result = rig.execute()
        assert result.outcome == "fault"
        assert result.reason.startswith("stimulator: ")
        assert result.reason.endswith(f"{words} at pulse 21 of channel triceps")
        assert len(rig.stimulator.sent) == 2
        assert rig.recording().columns["pulses/status"][41] == PulseStatus.DEVICE_ERROR

    def test_an_unasked_ack_names_its_channel(self, tmp_path: Path) -> None:
        rig = two(tmp_path)
        rig.at(0.7, lambda: (rig.stimulator._outputs.update({77: 1}), rig.stimulator._acknowledge(77, None)))
        result = rig.execute()
        assert "a pulse of channel triceps that it was not sent" in result.reason

    def test_what_was_left_out_climbs_on_its_own_channel(self, tmp_path: Path) -> None:
        """The triceps' line is blocked for a moment: the biceps goes on as wide as it was."""
        slow = part("ramp", up_s=1.0, down_s=0.025)
        segment = hold("both", on_s=1.0).model_copy(update={"channels": {"triceps": slow}})
        rig = two(tmp_path, [rest(0.5), segment, rest(0.5)])
        rig.gate.fire = _dropping(rig, 1, 60, 84)  # type: ignore[method-assign]
        rig.execute()
        t0_s = rig.run.t0_s or 0.0
        widths = {o: [p.pulse_width_us for s, p in rig.stimulator.sent if p.output == o] for o in (0, 1)}
        assert set(widths[0]) == {300}
        assert max(np.diff([0, *widths[1]])) <= 50
        late_us = [p.pulse_width_us for s, p in rig.stimulator.sent if p.output == 1 and s - t0_s > 84 / 80]
        assert late_us[0] <= 50 < 100 < max(late_us)

    def test_the_rise_is_per_channel(self, tmp_path: Path) -> None:
        """A width that jumps from channel to channel rises on none."""
        flat = {"triceps": part("ramp", up_s=1.0, down_s=1.0)}
        segment = SegmentPlan(name="ramp", sequence="ramp", settings={"up_s": 1.0, "down_s": 1.0}, channels=flat)
        rig = two(tmp_path, [rest(0.5), segment, rest(0.5)])
        assert rig.execute().outcome == "completed"
        planned_us, sent_us = (
            rig.recording().columns[f"pulses/{n}"] for n in ("pulse_width_us", "sent_pulse_width_us")
        )
        sent = np.nan_to_num(sent_us) > 0
        np.testing.assert_array_equal(sent_us[sent], np.floor(planned_us[sent]))

    def test_a_stop_stops_both(self, tmp_path: Path) -> None:
        rig = two(tmp_path)
        rig.at(0.8, lambda: rig.halt.set("stopped", "enough"))
        result = rig.execute()
        assert (result.outcome, rig.stimulator.armed) == ("stopped", False)
        t0_s = rig.run.t0_s or 0.0
        assert {p.output for _, p in rig.stimulator.sent} == {0, 1}
        assert max(s for s, _ in rig.stimulator.sent) - t0_s <= 0.81


def _dropping(rig: VirtualRig, channel: int, start: int, end: int) -> Callable[..., PulseStatus]:
    """A gate that drops one channel's pulses of some slots, as if they came too late."""
    true = rig.gate.fire

    def fire(index: int, pulse: Pulse, due_s: float, latest_s: float) -> PulseStatus:
        late = index % 2 == channel and start <= index < end
        return true(index, pulse, due_s, due_s - 1.0 if late else latest_s)

    return fire


class TestGate:
    """Limits at the gate hold although the plan was checked: what it is given is not believed."""

    @pytest.mark.parametrize(
        ("row", "hi", "most"),
        [
            ("all_charge_per_second_uc", 60.0, 10),
            ("all_charge_per_test_uc", 60.0, 10),
            ("simultaneous_current_ma", 25.0, 40),  # the triceps' 30 mA never pass
        ],
    )
    def test_the_sum(self, tmp_path: Path, row: str, hi: float, most: int) -> None:
        result, rig = self._narrowed(tmp_path, row, hi)
        assert len(rig.stimulator.sent) == most
        assert result.summary["channels"]["triceps"]["pulses"] == (0 if row.startswith("simul") else most // 2)

    @pytest.mark.parametrize("row", ["charge_per_second_uc", "charge_per_test_uc"])
    def test_each_by_itself(self, tmp_path: Path, row: str) -> None:
        rig = two(tmp_path)
        of_triceps = rig.test.channels[1].table
        of_triceps[row] = replace(of_triceps[row], hi=30.0)
        rig.execute()
        outputs = [p.output for _, p in rig.stimulator.sent]
        assert (outputs.count(0), outputs.count(1)) == (40, 5)

    def test_a_gap_that_is_too_short(self, tmp_path: Path) -> None:
        rig = two(tmp_path)
        rig.table["channel_gap_s"] = replace(BASE["channel_gap_s"], lo=0.0118)
        rig.execute()
        assert {p.output for _, p in rig.stimulator.sent} == {0}

    @staticmethod
    def _narrowed(folder: Path, row: str, hi: float) -> tuple[RunResult, VirtualRig]:
        rig = two(folder)
        rig.table[row] = replace(rig.table[row], hi=hi)
        return rig.execute(), rig


class TestRecords:
    def test_version_2(self, tmp_path: Path) -> None:
        rig = two(tmp_path)
        rig.execute()
        sealed = rig.seal()
        with h5py.File(sealed.path) as file:
            assert file.attrs["format_version"] == 2
            said = json.loads(file.attrs["channels"])
            columns = {name: np.asarray(file[f"pulses/{name}"]) for name in file["pulses"]}
            ends_s = np.asarray(file["segments/end_s"])
        assert said == [
            {**RIG[0].described(), "offset_s": 0.0},
            {**RIG[1].described(), "offset_s": 0.0125},
        ]
        assert columns["channel"].dtype == np.uint8
        np.testing.assert_array_equal(columns["channel"], np.arange(160) % 2)
        np.testing.assert_allclose(columns["planned_time_s"], np.arange(160) / 80)
        assert columns["current_ma"][40:44].tolist() == [20.0, 30.0, 20.0, 30.0]
        np.testing.assert_allclose(ends_s, [0.5, 1.5, 2.0])
        assert archive.verify(sealed.path) == sealed.content_sha256
        assert sealed.recording.alignment.method == "sync"
        assert sealed.recording.alignment.error_ms < 1.0

    def test_its_hash_covers_the_channel(self, tmp_path: Path) -> None:
        rig = two(tmp_path)
        rig.execute()
        data = bytearray(archive.to_bytes(rig.recording()))
        with h5py.File(io.BytesIO(data), "r+") as file:
            file["pulses/channel"][0] = 1
            changed = bytes(file.id.get_file_image())
        refused(lambda: archive.verify(tmp_path / "x.h5", io.BytesIO(changed)), "does not match")

    def test_one_channel_is_version_1(self, tmp_path: Path) -> None:
        rig = VirtualRig(tmp_path)
        rig.execute()
        recording = rig.recording()
        assert recording.attributes["format_version"] == 1
        assert "channels" not in recording.attributes
        assert "pulses/channel" not in recording.columns
        intents = [p for k, p in journal.read(rig.path).blocks if k == Kind.INTENT]
        assert {len(payload) for payload in intents} == {journal.INTENT.size}
        assert b"channel" not in rig.path.read_bytes()

    def test_one_named_channel_of_several(self, tmp_path: Path) -> None:
        """The second muscle alone: the recording must say which it was."""
        alone = [ChannelPlan(name="triceps", profile=TRICEPS)]
        rig = two(tmp_path, [rest(0.5), hold(), rest(0.5)], channels=alone)
        assert rig.execute().outcome == "completed"
        assert {p.output for _, p in rig.stimulator.sent} == {1}
        recording = rig.recording()
        assert recording.attributes["format_version"] == 2
        assert [one["name"] for one in json.loads(recording.attributes["channels"])] == ["triceps"]

    @pytest.mark.parametrize("offset_s", [0.0125, 0.004])
    def test_header_and_plan_are_lost(self, tmp_path: Path, offset_s: float) -> None:
        rig = two(tmp_path, channels=both(offset_s=offset_s))
        rig.execute()
        whole, contents = rig.recording(), journal.read(rig.path)
        kept = [block for block in contents.blocks if block[0] not in (Kind.HEADER, Kind.PLAN, Kind.SPACER)]
        found = assembly.assemble(replace(contents, blocks=kept, blocks_missing=5))
        assert found.attributes["format_version"] == 2
        assert found.attributes["pulse_rate_hz"] == pytest.approx(40.0)
        said = json.loads(found.attributes["channels"])
        assert [one["name"] for one in said] == ["output-1", "output-2"]
        assert said[1]["offset_s"] == pytest.approx(offset_s, abs=1e-4)
        for path in ("sent_pulse_width_us", "current_ma", "written_time_s", "channel", "status"):
            sent = np.flatnonzero(whole.columns["pulses/current_ma"])
            one, other = (of.columns[f"pulses/{path}"] for of in (whole, found))
            np.testing.assert_allclose(other[sent], one[sent], atol=1e-6)

    def test_a_lost_intent_is_replaced_by_its_channels_plan(self, tmp_path: Path) -> None:
        rig = two(tmp_path)
        rig.execute()
        contents = journal.read(rig.path)
        lost = [b for b in contents.blocks if not (b[0] == Kind.INTENT and Intent.from_bytes(b[1]).slot == 43)]
        columns = assembly.assemble(replace(contents, blocks=lost, blocks_missing=1)).columns
        assert (columns["pulses/sent_pulse_width_us"][43], columns["pulses/current_ma"][43]) == (200.0, 30.0)

    def test_older_intents_are_readable(self) -> None:
        assert Intent.from_bytes(journal.INTENT.pack(3, 1.0, 2.0, 100.0, 20.0)) == Intent(3, 1.0, 2.0, 100.0, 20.0)
        several = Intent(3, 1.0, 2.0, 100.0, 20.0, 1, 2, 5)
        assert Intent.from_bytes(several.to_bytes(named=True)) == several


FIXED = [rest(0.5), on_both(), on_both(on_s=0.5)]


def adaptive(folder: Path, max_s: float = 10.0, max_nms: float = 1e4, **more: Any) -> VirtualRig:
    bounds = AdaptivePlan(max_duration_s=max_s, max_torque_time_nms=max_nms)
    return two(folder, FIXED, adaptive=bounds, **more)


def laid(rig: VirtualRig) -> list[journal.LaidBlock]:
    return [journal.LaidBlock.from_bytes(p) for k, p in journal.read(rig.path).blocks if k == Kind.LAID]


class TestAdaptive:
    def test_segments_with_channels_are_laid(self, tmp_path: Path) -> None:
        rig = adaptive(tmp_path)
        chosen = SegmentPlan(
            name="triceps-only", sequence="rest", settings={"duration_s": 0.1}, channels={"triceps": part(on_s=0.5)}
        )
        extend(rig, rig.run.score.decided, [chosen])
        result = rig.execute()
        assert (result.outcome, result.summary["ended_by"]) == ("completed", "plan")
        assert [block.segment.name for block in laid(rig)] == ["triceps-only", "both", "both", "rest"]
        assert all(block.segment.start % 2 == 0 == len(block.pulse_width_us) % 2 for block in laid(rig))
        columns = rig.recording().columns
        own = columns["pulses/pulse_width_us"][40:80].reshape(-1, 2)
        np.testing.assert_array_equal(own, [[0.0, 200.0]] * 20)
        assert not columns["pulses/pulse_width_us"][-80:].any()

    @pytest.mark.parametrize("cut", [101, 102])
    def test_it_ends_well_in_the_middle_of_a_round(self, tmp_path: Path, cut: int) -> None:
        rig = adaptive(tmp_path)
        due_s = rig.run.score.train.due_s(cut - 1)
        rig.at(due_s + 0.002, lambda: rig.run.score.enough("page", at_once=True))
        result = rig.execute()
        assert (result.outcome, result.summary["ended_by"]) == ("completed", "enough")
        recording = rig.recording()
        widths_us, status = (recording.columns[f"pulses/{n}"] for n in ("pulse_width_us", "status"))
        assert len(widths_us) % 2 == 0
        last = int(np.flatnonzero(widths_us)[-1])
        assert abs(last - cut) <= 2
        assert np.sum(status == PulseStatus.ACKNOWLEDGED) == np.count_nonzero(widths_us) == len(rig.stimulator.sent)
        assert len(widths_us) - 1 - last >= 80 - 1
        assert all(len(block.pulse_width_us) % 2 == 0 for block in laid(rig))
        assert recording.columns["segments/end_s"][-1] == pytest.approx(len(widths_us) / 80)

    def test_torque_time_ends_both(self, tmp_path: Path) -> None:
        rig = adaptive(tmp_path, max_nms=0.5)
        result = rig.execute()
        assert result.summary["ended_by"] == "torque_time"
        assert not rig.recording().columns["pulses/pulse_width_us"][-79:].any()

    @pytest.mark.parametrize("row", ["all_charge_per_test_uc", "charge_per_test_uc"])
    def test_bounds_hold_for_each_and_the_sum(self, tmp_path: Path, row: str) -> None:
        narrow = {**BASE, row: replace(BASE[row], hi=900.0 if row.startswith("all") else 500.0)}
        rig = adaptive(tmp_path, base=narrow)
        wanted = SegmentPlan(
            name="much", sequence="rest", settings={"duration_s": 0.1}, channels={"triceps": part(on_s=4.0)}
        )
        refused(lambda: extend(rig, rig.run.score.decided, [wanted]), row)
        assert rig.run.score.left(0.0).charge_left_uc == pytest.approx(narrow[row].hi)

    def test_a_safe_end_is_a_second_of_all(self) -> None:
        train = Train(40.0, (0.0, 0.0125))
        assert plan.safe_end(np.full(80, 100.0), train) == 80
        assert plan.safe_end(np.array([100.0, 100.0, 100.0]), train) == 81
        assert plan.safe_end(np.zeros(160), train) == 0

    def test_a_damaged_journal(self, tmp_path: Path) -> None:
        """Without one laid block: still whole rounds, and every pulse that was sent is in it."""
        rig = adaptive(tmp_path)
        rig.at(1.01, lambda: void(rig.run.score.enough("page", at_once=True)))
        rig.execute()
        contents = journal.read(rig.path)
        for missing in range(len(laid(rig))):
            numbers = itertools.count()
            kept = [b for b in contents.blocks if not (b[0] == Kind.LAID and next(numbers) == missing)]
            columns = assembly.assemble(replace(contents, blocks=kept, blocks_missing=1)).columns
            felt = np.isin(columns["pulses/status"], (PulseStatus.ACKNOWLEDGED, PulseStatus.UNACKNOWLEDGED))
            assert felt.sum() >= len(rig.stimulator.sent)
            assert len(columns["pulses/channel"]) == len(felt)


def test_names_in_words() -> None:
    test = planned([on_both()])
    assert channels.named(test.channels, 1) == " of channel triceps"
    assert channels.named(test.channels, 7) == ""
