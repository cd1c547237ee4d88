"""What must hold in every life, judged by what the emulated electrode felt and by the files that are left.

This page is the safety case's list: docs/safety/hazards.toml points at its functions. The bounds are written here once
more on purpose: a mistake in the rig's own table must not excuse itself. Each function gives what is wrong, one line
each; nothing where all is well. Pulses of a command that was doubled, corrupted or overtaken on the line are the
line's; after them the rig must stop like after any fault.
"""

from __future__ import annotations

import io
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterator
from functools import lru_cache
from inspect import isgeneratorfunction
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from stimrig.hardware_sim.angle_sensor import CAN_ID as ANGLE_ID
from stimrig.rig import journal
from stimrig.rig.errors import RecordingError
from tests.simulator.clinic import Asked
from tests.simulator.life import FOLDER, Felt, Life

ON_ITS_WAY_S = 0.06
"""A command that nothing holds is felt within this time: the line's transit, and what the stimulator does before it."""
CLOSEST_S = 0.008
MOST_PULSES_A_SECOND = 60
MOST_UC_A_SECOND = 1600.0
MOST_UC_A_PULSE = 40.0
MOST_UC_A_TEST = 50_000.0
LONGEST_TEST_S = 6.0
"""What the people of a life ask for at most."""
REST_S, REST_BETWEEN_TRAINS_S = 1.0, 0.5
MOST_RISE_UC = 1.0
MOST_STEP_US = 50.0
TRAIN_RATE_HZ = 40.0
LATEST, EARLY = 0.2, 0.1
"""Of a period: what is later than the first is left out; within the second are those that came in time."""
BLIND_S = 0.1
"""Without a sample read for so long, nothing is sent."""
DECIDED_S = 0.01
"""From the look at a sensor to the command; 0.2 of the longest period of these lives."""
UNANSWERED_S = 0.68
"""Without an acknowledgement for 0.1 s a test ends, at the next pulse; after a standstill within 0.5 s."""
TAKEN_BACK_S = 0.05
STILL_S = 1.06
"""A sender may be late by 1 s, and its next look is due within a period."""
GAP_S = 0.25
"""Only a standstill of the computer leaves out so many pulses in a row."""
NOTICED_S = 0.15
"""A sample that must end a test may be so old as it is read, with what the alignment may be wrong by."""
SYNCED_WITHIN_S = 1.0
"""What is older than this survives a power failure, on a disk that works."""
OPEN_WORK_S = 8.0
"""Within this time a slow disk has ended what it was given."""
NOT_OF_THE_CELL = tuple(
    f"device_fault {name}" for name in (
        "no_ack", "late_ack", "electrode_error", "emergency_switch", "high_voltage_error", "stimulator_unplugged",
        "angle",
    )
)  # fmt: skip
ANSWERED_S = 8.0
"""A stop waits up to 6 s for what the torque shows."""
WRITTEN_S = 0.05
"""A latch is on a disk that works within this time."""
OUTPUT = 0, 0
"""Of the rig file: connector and channel, from 0."""
STATES = {"ready", "latched", "uncertain", "disconnected", "calibrating"}


def every_pulse_is_within_the_limits(life: Life) -> Iterator[str]:
    """Width, current, charge, balance: of every pulse, whatever the line did to its command."""
    widest_us, most_ma = life.profile.max_pulse_width_us, life.profile.current_ma
    for pulse in life.felt:
        if pulse.output != OUTPUT:
            yield f"{pulse.time_s:.4f} s: at an output that is not the rig file's"
        if not (0 < pulse.width_us <= widest_us and 0 < pulse.current_ma <= most_ma):
            yield f"{pulse.time_s:.4f} s: {pulse.width_us:g} µs, {pulse.current_ma:g} mA"
        if not (pulse.width_us * pulse.current_ma * 1e-3 <= MOST_UC_A_PULSE) or not pulse.balanced:
            yield f"{pulse.time_s:.4f} s: too much charge, or not balanced"


def pulses_are_apart_and_not_too_many(life: Life) -> Iterator[str]:
    """Interval, rate and charge of each second."""
    felt = _true(life)
    for one, other in pairwise(felt):
        if not (other.time_s - one.time_s >= CLOSEST_S - 1e-6):
            yield f"{other.time_s:.4f} s: {1e3 * (other.time_s - one.time_s):.2f} ms after the pulse before"
    for last, pulse in enumerate(felt):
        second = [p for p in felt[: last + 1] if p.time_s > pulse.time_s - 1.0]
        charge_uc = sum(p.width_us * p.current_ma * 1e-3 for p in second)
        if not (len(second) <= MOST_PULSES_A_SECOND and charge_uc <= MOST_UC_A_SECOND + 1e-6):
            yield f"{pulse.time_s:.4f} s: {len(second)} pulses, {charge_uc:.1f} µC within a second"


def a_test_is_no_longer_and_no_more_than_asked(life: Life) -> Iterator[str]:
    """Duration and charge of each test, from what was felt."""
    for name, felt in _by_test(life).items():
        if not (felt[-1].time_s - felt[0].time_s <= LONGEST_TEST_S):
            yield f"{name}: felt for {felt[-1].time_s - felt[0].time_s:.2f} s"
        if not (sum(p.width_us * p.current_ma * 1e-3 for p in felt) <= MOST_UC_A_TEST):
            yield f"{name}: too much charge"


def pulses_keep_their_pace(life: Life) -> Iterator[str]:
    """Each is decided within a share of the period after it was due: a late one is left out, never sent in a burst."""
    for name, felt in _by_test(life).items():
        period_s = 1 / (TRAIN_RATE_HZ if _calibration(name) else life.rate_hz)
        phases = np.array([life.wires.decided_s[pulse.written_s] / period_s % 1.0 for pulse in felt])
        after = (phases[None, :] - phases[:, None]) % 1.0
        late = after[np.argmax(np.sum(after < EARLY, axis=1))]  # most are in time
        for pulse, share in zip(felt, late, strict=True):
            if len(felt) >= 8 and not (share <= LATEST + EARLY or share >= 1 - EARLY):
                yield f"{pulse.time_s:.4f} s: {1e3 * share * period_s:.1f} ms late in {name}"


def tests_are_apart(life: Life) -> Iterator[str]:
    """The rest between two tests, and between two trains of one calibration."""
    for (one, felt), (other, after) in pairwise(_by_test(life).items()):
        least_s = REST_BETWEEN_TRAINS_S if _calibration(one) and _calibration(one) == _calibration(other) else REST_S
        if not (after[0].time_s - felt[-1].time_s >= least_s - 1e-3):
            yield f"{other}: felt {after[0].time_s - felt[-1].time_s:.3f} s after {one}"


def trains_rise_in_small_steps(life: Life) -> Iterator[str]:
    """No train of a calibration carries much more charge than those that were felt before it."""
    most_uc: dict[str, float] = {}
    for name, felt in _by_test(life).items():
        if calibration := _calibration(name):
            uc = max(p.width_us * p.current_ma * 1e-3 for p in felt)
            if not (uc <= most_uc.get(calibration, 0.0) + MOST_RISE_UC + 1e-9):
                yield f"{name}: {uc:.2f} µC, {most_uc.get(calibration, 0.0):.2f} µC before"
            most_uc[calibration] = max(uc, most_uc.get(calibration, 0.0))


def nothing_is_written_blind(life: Life) -> Iterator[str]:
    """No command unless torque came just before, and the angle where the test asks for it."""
    for frame_id, read_s in life.wires.read_s.items():
        for name, felt in _by_test(life).items():
            if frame_id == ANGLE_ID and _calibration(name):
                continue  # a train asks for no angle
            for pulse in felt:
                decided_s = life.wires.decided_s[pulse.written_s]
                at = bisect_right(read_s, decided_s)
                if not (at and decided_s - read_s[at - 1] <= BLIND_S + DECIDED_S + 1e-3):
                    yield f"{pulse.time_s:.4f} s: written without a frame {frame_id:#x} just before"


def one_pulse_is_on_its_way(life: Life) -> Iterator[str]:
    """No command before the stimulator has said something after the pulse before it."""
    for felt in _by_test(life).values():
        for one, other in pairwise(felt):
            if not (_answered_s(life)[one] <= life.wires.decided_s[other.written_s]):
                yield f"{other.time_s:.4f} s: written before the pulse at {one.time_s:.4f} s was acknowledged"


def a_missing_acknowledgement_ends_a_test(life: Life) -> Iterator[str]:
    """Although what comes at last would let the next pulse pass."""
    for felt in _by_test(life).values():
        for one, other in pairwise(felt):
            silent_s = _answered_s(life)[one] - one.written_s
            silent_s -= sum(for_s for from_s, for_s in _stood(life) if one.written_s - for_s < from_s < other.written_s)
            if not (silent_s <= UNANSWERED_S):
                yield f"{other.time_s:.4f} s: {silent_s:.2f} s without a word after a pulse before it"


def a_long_standstill_ends_a_test(life: Life) -> Iterator[str]:
    """Where nothing ran for more than a second while pulses were due, none of that test follows."""
    for from_s, to_s in life.computer.pauses:
        for name, felt in _by_test(life).items():
            if to_s - from_s > STILL_S and felt[0].written_s < from_s and felt[-1].written_s > to_s:
                yield f"{name}: goes on after the computer stood still for {to_s - from_s:.2f} s at {from_s:.4f} s"


def a_torque_beyond_its_limit_ends_a_test(life: Life) -> Iterator[str]:
    """Or one that is no number."""
    for path, columns in _recordings(life):
        torque_nm, time_s = columns["torque/torque_nm"], columns["torque/time_s"]
        beyond = ~(np.abs(torque_nm) <= life.profile.max_torque_nm)
        written_s = columns["pulses/written_time_s"]
        if _calibration(_name(path)) == "" and beyond.any():
            since_s = time_s[np.argmax(beyond)]
            if np.any(written_s > since_s + NOTICED_S):
                yield f"{path}: pulses after a torque of {torque_nm[np.argmax(beyond)]:g} N·m at {since_s:.3f} s"


def nothing_is_written_while_stopped(life: Life) -> Iterator[str]:
    """After a stop or a fault no command is written until a person has re-armed, and none by a process that is dead."""
    barred = _barred(life)
    for pulse in life.felt:
        stopped_s = [since_s for since_s, until_s in barred if since_s < pulse.written_s < until_s]
        if stopped_s:
            yield f"{pulse.time_s:.4f} s: written at {pulse.written_s:.4f} s, stopped since {stopped_s[0]:.4f} s"


def a_stop_is_undone_only_by_who_was_shown_it(life: Life) -> Iterator[str]:
    """After a stop or a fault no rig is ready, arms or calibrates until somebody re-armed who was shown that one."""
    came = [
        (asked.obeyed_s, _shown_s(life, asked))
        for asked in life.clinic.asked
        if asked.kind == "rearm" and asked.obeyed_s is not None and not _refused(asked)
    ]
    for since_s, told_s in _stops(life):
        until_s = _forgotten(life, since_s)
        for time_s, _, state, *_ in life.clinic.states:
            works = state in ("ready", "calibrating", "arming") and since_s < time_s <= until_s
            if works and not any(shown_s >= told_s and obeyed_s <= time_s for obeyed_s, shown_s in came):
                yield f"{time_s:.4f} s: {state}, and nobody re-armed who was shown the stop at {since_s:.4f} s"


def nothing_of_a_withdrawn_test_is_written(life: Life) -> Iterator[str]:
    """From the moment on at which the rig took a withdrawal to which it says yes."""
    played_by = {asked.about: asked.process for asked in life.clinic.asked if asked.kind == "start"}
    for asked in life.clinic.asked:
        if asked.kind != "withdraw" or asked.reply is None or played_by[asked.about] is not asked.process:
            continue
        for pulse in _by_test(life).get(asked.about, []) if asked.reply.body.get("withdrawn") else []:
            if pulse.written_s > (asked.obeyed_s or 0.0):
                yield f"{pulse.time_s:.4f} s: {asked.about} was withdrawn at {asked.obeyed_s:.4f} s"


def a_calibrations_result_waits_until_it_is_stored(life: Life) -> Iterator[str]:
    """From its answer on each status tells it, whichever process, until somebody says that it is stored, or discards
    it: the first of such requests that came."""
    asked = [one for one in life.clinic.asked if one.obeyed_s is not None]
    for done in asked:
        profile = done.reply is not None and done.reply.ok and done.reply.body.get("profile")
        if done.kind != "calibrate-finish" or not profile:
            continue
        let_go_s = (one.obeyed_s for one in asked if one.lets_go and one.place > done.place)
        until_s = min(let_go_s, default=np.inf)
        for told in life.clinic.states:
            if (done.replied_s or 0.0) < told.time_s < until_s and not told.calibrated and told.state != "disconnected":
                yield f"{told.time_s:.4f} s: the result of {done.replied_s} s is told no more, and nobody stored it"


def no_pulse_is_felt_late(life: Life) -> Iterator[str]:
    """A line that held what was sent may let go of one pulse, never of several, whatever ended the test meanwhile."""
    late = [pulse for pulse in _true(life) if not (pulse.time_s - pulse.written_s <= ON_ITS_WAY_S)]
    for one, other in pairwise(late):
        if other.written_s - one.time_s < 0:
            yield f"{other.time_s:.4f} s: felt late, beside the one written at {one.written_s:.4f} s"


def a_stop_takes_back_what_has_not_left(life: Life) -> Iterator[str]:
    """A command that still waits in the computer as a test is ended is felt by nobody."""
    ends = [time_s for time_s, _, state, *_ in life.clinic.states if state == "stopping"]
    stood = [*life.computer.pauses, *((death_s, np.inf) for death_s in life.deaths)]
    for pulse in _true(life):
        left_s = life.wires.to_device.left_late_s.get(pulse.written_s, 0.0)
        for end_s in ends:
            ran = not any(from_s < end_s + TAKEN_BACK_S and end_s < to_s for from_s, to_s in stood)
            if pulse.written_s < end_s < left_s - TAKEN_BACK_S and ran:
                yield f"{pulse.time_s:.4f} s: it waited in the computer as its test was ended at {end_s:.4f} s"


def a_confirmed_stop_is_true(life: Life) -> Iterator[str]:
    """After its answer no pulse is felt that was written before, unless it says that one may be; the device is off."""
    for asked in life.clinic.asked:
        if asked.kind != "stop" or asked.reply is None or asked.replied_s is None or not asked.reply.ok:
            continue
        body = asked.reply.body or {}
        if body.get("pulse_may_follow"):
            continue
        if body.get("confirmed") and asked.armed:
            yield f"{asked.replied_s:.4f} s: a stop is confirmed, the stimulator can still stimulate"
        for pulse in _true(life):
            if pulse.written_s < asked.replied_s < pulse.time_s:
                yield f"{pulse.time_s:.4f} s: felt after the answer to a stop at {asked.replied_s:.4f} s"


def every_test_ends_in_a_documented_state(life: Life) -> Iterator[str]:
    """And once all is well again, a re-armed rig plays a test to its end."""
    if not life.people.saw_one_end:
        yield f"no test was played to its end within the quiet time; the rig is {life.clinic.state}"
    for event in life.clinic.finished:
        if event.outcome not in ("completed", "stopped", "fault"):
            yield f"{event.test_id} ended with {event.outcome!r}"


def every_pulse_has_its_intent_and_its_record(life: Life) -> Iterator[str]:
    """What was felt stands in the file of its test, in the same order."""
    recorded = _tests(life)
    for name, felt in _by_test(life).items():
        sent, at = recorded.get(name, []), 0
        for pulse in felt:
            place = next((place for place in range(at, len(sent)) if _same(pulse, sent[place])), None)
            if place is not None:
                at = place + 1
            elif not _lost_with_the_power(life, pulse):
                yield f"{pulse.time_s:.4f} s: {pulse.width_us:g} µs stands in no file of test {name}"


def what_the_files_call_acknowledged_was_felt(life: Life) -> Iterator[str]:
    """No more acknowledged pulses in the files than were felt; a pulse of which a RehaStim 2 reports that it failed is
    acknowledged first, and ends its test or its train: it is told once, however often that is told again."""
    acknowledged = sum(1 for test in _tests(life).values() for _, _, status in test if status == 0)
    failed = sum(
        told.process is before.process and "stimulator:" in told.reason and "stimulator:" not in before.reason
        for before, told in pairwise(life.clinic.states)
    )
    if acknowledged > len(life.felt) + failed:
        yield f"{acknowledged} pulses acknowledged, {len(life.felt)} felt"


def every_test_that_began_is_found(life: Life) -> Iterator[str]:
    """A recording, or the journal that it was or will be made of."""
    names = {_name(path) for path in life.disk.files}
    for asked in life.clinic.asked:
        began = asked.kind == "start" and asked.reply is not None and asked.reply.ok
        if began and asked.about not in names:
            yield f"{asked.about} left no file"
    for event in life.clinic.finished:
        if event.recording_path is not None and not any(str(path) == event.recording_path for path in life.disk.files):
            yield f"{event.test_id}: {event.recording_path} is gone"


def every_request_is_answered(life: Life) -> Iterator[str]:
    """By the process that took it, unless that died meanwhile."""
    for asked in life.clinic.asked:
        took = asked.obeyed_s is not None and asked.process.alive
        if took and asked.reply is None and not (life.world.now_s - (asked.obeyed_s or 0.0) <= ANSWERED_S):
            yield f"{asked.obeyed_s:.4f} s: {asked.kind} has no answer"


def recordings_are_whole_and_in_order(life: Life) -> Iterator[str]:
    """Counters rise, times rise, and each file's content is what its hash says."""
    for path, columns in _recordings(life):
        counter, time_s = columns["torque/counter"], columns["torque/time_s"]
        if len(time_s) > 1 and not np.all(np.diff(time_s) > 0):
            yield f"{path}: its times do not rise"
        if len(counter) > 1 and counter[0] >= 0 and not np.all(np.diff(counter) > 0):
            yield f"{path}: its counter does not rise"


def after_a_pause_the_width_climbs_from_nothing(life: Life) -> Iterator[str]:
    """As at the start of a train, also where the sequence may jump."""
    for path, columns in _recordings(life):
        planned_s, planned_us, sent_us = (
            columns[f"pulses/{name}"] for name in ("planned_time_s", "pulse_width_us", "sent_pulse_width_us")
        )
        sent = np.flatnonzero(np.isfinite(sent_us))
        for one, other in pairwise(sent):
            left_out = np.all(planned_us[one + 1 : other] > 0) and planned_s[other] - planned_s[one] > GAP_S
            if left_out and not (sent_us[other] <= MOST_STEP_US + 1):
                yield f"{path}: pulse {other + 1} has {sent_us[other]:g} µs after a pause"


def what_is_left_out_makes_no_steeper_rise(life: Life) -> Iterator[str]:
    """Where the plan rises in small steps, so does what was sent, also over pulses that were left out."""
    for path, columns in _recordings(life):
        if path.stem.rpartition("_")[2] in life.people.jumping:
            continue
        planned_us, sent_us = columns["pulses/pulse_width_us"], columns["pulses/sent_pulse_width_us"]
        sent = np.flatnonzero(np.isfinite(sent_us) | (planned_us == 0))
        sent_us = np.where(planned_us == 0, 0.0, sent_us)
        for one, other in pairwise(sent):
            steps_us = np.diff(planned_us[one : other + 1])
            if np.all(steps_us <= MOST_STEP_US) and not (sent_us[other] - sent_us[one] <= MOST_STEP_US + 1):
                yield f"{path}: pulse {other + 1} has {sent_us[other]:g} µs, {sent_us[one]:g} µs were felt before"


def recordings_hold_every_sample(life: Life) -> Iterator[str]:
    """Where the cell had no fault: none between the first and the last is missing, and the pulses lie among them."""
    if any(words.startswith("device") and not words.startswith(NOT_OF_THE_CELL) for words in life.befallen):
        return
    for path, columns in _recordings(life):
        counter, time_s, written_s = (columns[name] for name in ("torque/counter", *_TIMES))
        if len(counter) and counter[0] >= 0 and not np.all(np.diff(counter) == 1):
            yield f"{path}: {np.sum(np.diff(counter) - 1)} samples are missing"
        sent_s = written_s[np.isfinite(written_s)]
        if not len(sent_s):
            continue
        since_s, until_s = time_s[[0, -1]] if len(time_s) else sent_s[[0, 0]]  # a fault may come before any sample
        if not (since_s - NOTICED_S <= sent_s[0] and sent_s[-1] <= until_s + BLIND_S + NOTICED_S):
            yield f"{path}: its pulses lie outside its samples"


INVARIANTS: tuple[Callable[[Life], Iterator[str]], ...] = tuple(
    found for name, found in [*globals().items()] if isgeneratorfunction(found) and not name.startswith("_")
)
"""All of the above."""


def broken(life: Life) -> list[str]:
    """What did not hold, one line each."""
    return [f"{invariant.__name__}: {words}" for invariant in INVARIANTS for words in invariant(life)]


def _true(life: Life) -> list[Felt]:
    return [pulse for pulse in life.felt if pulse.true]


def _barred(life: Life) -> list[tuple[float, float]]:
    """Times during which nothing may be written, world's time. A re-arm counts for what its person was shown.

    One whose latch was told before a stop releases no such stop, whenever it comes."""
    rearmed = [
        (_shown_s(life, one), _effect_s(life, one))
        for one in life.clinic.asked
        if one.kind == "rearm" and one.obeyed_s is not None and not _refused(one)
    ]
    until = [
        (since_s, min((by_s for shown_s, by_s in rearmed if shown_s >= told_s), default=np.inf))
        for since_s, told_s in _stops(life)
    ]
    until = [(since_s, min(until_s, _forgotten(life, since_s))) for since_s, until_s in until]
    born = [time_s for time_s, _, state, *_ in life.clinic.states if state in STATES]
    return until + [(death_s, min((s for s in born if s > death_s), default=np.inf)) for death_s in life.deaths]


def _stops(life: Life) -> Iterator[tuple[float, float]]:
    """When it was stopped, and when those who re-arm must have been shown that at the earliest.

    By a request, or a process told that it is stopped; one that only tells more of it was stopped before."""
    for asked in life.clinic.asked:
        if asked.kind == "stop" and asked.obeyed_s is not None:
            yield asked.obeyed_s, asked.obeyed_s
    before: tuple[Any, str] = (None, "")
    for time_s, process, state, latch, *_ in life.clinic.states:
        if state in ("latched", "uncertain") and (process, state) != before:
            yield time_s, life.clinic.shown[latch]  # perhaps while its test was being ended
        before = process, state


def _shown_s(life: Life, rearm: Asked) -> float:
    """When the latch that a re-arm names was told first."""
    return life.clinic.shown.get(rearm.latch, -np.inf)


def _effect_s(life: Life, rearm: Asked) -> float:
    """When a re-arm took effect: replied to, or the latch gone from the disk before the process died."""
    if rearm.replied_s is not None:
        return rearm.replied_s
    death_s = min((time_s for time_s in life.deaths if time_s > (rearm.obeyed_s or 0.0)), default=np.inf)
    gone = (time_s for time_s, name in life.disk.removed if name == "latch.json" and time_s > (rearm.obeyed_s or 0.0))
    return next((time_s for time_s in gone if time_s <= death_s), np.inf)


def _forgotten(life: Life, since_s: float) -> float:
    """When a process died whose latch is not on the disk, so that the next one cannot know of it; infinite: never.

    Either the disk had refused it, or was writing as the process died and no stop had been confirmed."""
    written = [(time_s, took) for time_s, name, took in life.disk.replaced if name == "latch.json"]
    removed = [(time_s, False) for time_s, name in life.disk.removed if name == "latch.json"]
    stops = [asked for asked in life.clinic.asked if asked.kind == "stop" and asked.obeyed_s == since_s]
    told_s = min((stop.replied_s for stop in stops if stop.replied_s), default=np.inf)
    for death_s in (death_s for death_s in life.deaths if death_s >= since_s):
        refused = [took for time_s, took in written if time_s < death_s][-1:] == [False]
        _, stays = max((found for found in written + removed if found[0] < death_s), default=(0.0, False))
        under_way = death_s in life.died_writing or death_s - since_s < WRITTEN_S
        if refused or (not stays and under_way and death_s < told_s):
            return death_s
    return np.inf


Sent = tuple[float, float, int]
"""A recorded pulse that may have been sent: its width, µs; its current, mA; its status."""


@lru_cache(maxsize=1)
def _by_test(life: Life) -> dict[str, list[Felt]]:
    """The pulses that were felt as they were sent, by the test that was begun last before they were written."""
    begun = [
        (asked.obeyed_s, asked.about or _told_test(asked))
        for asked in life.clinic.asked
        if asked.obeyed_s is not None and not _refused(asked) and asked.kind in ("start", "calibrate-step")
    ]
    found: dict[str, list[Felt]] = {}
    for pulse in sorted(_true(life), key=lambda pulse: pulse.written_s):
        name = max(((since_s, name) for since_s, name in begun if since_s < pulse.written_s), default=(0.0, "none"))[1]
        found.setdefault(name, []).append(pulse)
    return found


@lru_cache(maxsize=1)
def _answered_s(life: Life) -> dict[Felt, float]:
    """When the rig took the first word that the stimulator sent after each pulse; infinite: none came."""
    heard = sorted(life.wires.heard)
    sent_s = [sent_s for sent_s, _ in heard]
    first_s = list(accumulate((taken_s for _, taken_s in reversed(heard)), min, initial=np.inf))[::-1]
    return {pulse: first_s[bisect_left(sent_s, pulse.time_s - 1e-9)] for pulse in life.felt}


def _told_test(asked: Asked) -> str:
    """The test that a reply names."""
    body = None if asked.reply is None else asked.reply.body
    return str((body or {}).get("test_id"))


def _calibration(name: str) -> str:
    """That a train belongs to; empty for a test."""
    return name.partition(".")[0] if "." in name else ""


def _refused(asked: Asked) -> bool:
    return asked.reply is not None and not asked.reply.ok


@lru_cache(maxsize=1)
def _tests(life: Life) -> dict[str, list[Sent]]:
    """The pulses of each test's file, by the test's name."""
    found: dict[str, list[Sent]] = {}
    for path, columns in _recordings(life):
        sent = np.isfinite(columns["pulses/sent_pulse_width_us"])
        found[_name(path)] = list(
            zip(
                columns["pulses/sent_pulse_width_us"][sent],
                columns["pulses/current_ma"][sent],
                columns["pulses/status"][sent],
                strict=True,
            )
        )
    for path, file in life.disk.files.items():
        if path.parent.name == "journals" and _name(path) not in found:
            found[_name(path)] = _of_journal(path, bytes(file.data))
    return found


def _of_journal(path: Any, data: bytes) -> list[Sent]:
    try:
        blocks = journal.parse(path, data).blocks
    except RecordingError:
        return []
    intents = [journal.INTENT.unpack(payload) for kind, payload in blocks if kind == journal.Kind.INTENT]
    return [(width_us, current_ma, 4) for _, _, _, width_us, current_ma in intents]


def _name(path: Path) -> str:
    """Of a test, from its file: `…Z_t12.h5`, `t12.journal`."""
    return path.stem.rpartition("Z_")[2]


@lru_cache(maxsize=1)
def _recordings(life: Life) -> list[tuple[Path, dict[str, np.ndarray]]]:
    found = []
    for path, file in life.disk.files.items():
        if path.parent == FOLDER / "recordings":
            with h5py.File(io.BytesIO(bytes(file.data)), "r") as opened:
                found.append((path, {name: np.asarray(opened[name]) for name in _COLUMNS}))
    return found


_TIMES = "torque/time_s", "pulses/written_time_s"
_COLUMNS = (
    *_TIMES, "torque/counter", "torque/torque_nm", "pulses/planned_time_s", "pulses/pulse_width_us",
    "pulses/sent_pulse_width_us", "pulses/current_ma", "pulses/status",
)  # fmt: skip


def _same(pulse: Felt, recorded: Sent) -> bool:
    return abs(pulse.width_us - recorded[0]) < 1e-6 and abs(pulse.current_ma - recorded[1]) < 1e-6


def _stood(life: Life) -> list[tuple[float, float]]:
    """When nothing ran on the computer, and for how long."""
    return [(from_s, to_s - from_s) for from_s, to_s in life.computer.pauses] + life.computer.stalls


def _lost_with_the_power(life: Life, pulse: Felt) -> bool:
    """Whether it was written too shortly before a power failure to be synced.

    The rig has longer by what it stood still, and no bound where pieces of work that a slow disk took may be open."""
    stood = _stood(life)
    for time_s, well_since_s in life.power_failures:
        if well_since_s > time_s - OPEN_WORK_S:
            patience_s = OPEN_WORK_S
        else:
            patience_s = SYNCED_WITHIN_S + sum(for_s for from_s, for_s in stood if from_s > time_s - OPEN_WORK_S)
        if time_s - patience_s <= pulse.written_s <= time_s:
            return True
    return False
