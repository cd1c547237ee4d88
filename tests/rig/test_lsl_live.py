"""What goes to LSL, from a journal that grows: the recording's values, once each, at its times; without LSL itself."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest

from stimrig.rig import assembly, journal
from stimrig.rig.errors import RecordingError
from stimrig.rig.journal import Kind
from stimrig.rig.lsl_outlets.live_test import MARGIN_S, Batch, LiveTest
from stimrig.rig.lsl_outlets.streaming import Journals, Outlets, Streaming, Tail, refuse_locking
from stimrig.rig.signals import SAMPLE
from tests.rig.fakes import VirtualRig, journal_at
from tests.rig.test_channels import two

pytestmark = pytest.mark.slow

RATE_HZ, PULSE_HZ, T0_S = 1600.0, 40.0, 100.0
PLAN = {"test_id": "t", "participant": "P17", "kind": "sequence", "pulse_rate_hz": PULSE_HZ, "adaptive": None}


def write_journal(path: Path, seed: int, rest_s: float, long_s: float, ppm: float = 0.0, **cell: bool) -> None:
    """A test on synthetic clocks: rest, then pulses; blocks in the order of their times."""
    rng = np.random.default_rng(seed)
    n = int((long_s + 0.5) * RATE_HZ)
    true_s = T0_S - 0.3 + np.arange(n) / RATE_HZ * (1 + ppm * 1e-6)
    host_s = np.maximum.accumulate(true_s + 3e-4 + rng.exponential(4e-4, n) + (rng.random(n) < 1e-3) * 0.02)
    due_s = T0_S + np.arange(round(rest_s * PULSE_HZ), round(long_s * PULSE_HZ)) / PULSE_HZ
    written_s = due_s + rng.exponential(1e-4, len(due_s))
    samples = np.zeros(n, SAMPLE)
    samples["host_time_s"], samples["stamp_s"] = host_s, np.nan
    samples["torque_nm"] = np.sin(true_s) + rng.normal(0, 0.01, n)
    samples["counter"] = np.arange(n) + 70000 if cell.get("counter", True) else -1
    samples["sync"] = 0 if cell.get("sync", True) else 255
    if cell.get("sync", True):
        samples["sync"][np.searchsorted(true_s, written_s)] = 1
    blocks: list[tuple[float, Kind, bytes]] = [(T0_S - 0.1, Kind.START, b'{"t0_s": 100.0, "unix_s": 1.7e9}')]
    for i, due in enumerate(due_s):
        index, at_s = round((due - T0_S) * PULSE_HZ), written_s[i]
        blocks += [
            (due, Kind.INTENT, journal.INTENT.pack(index, due, due, 100.0 + index, 20.0)),
            (at_s, Kind.WRITTEN, journal.WRITTEN.pack(index, index % 64, at_s)),
            (at_s + 0.002, Kind.ACKED, journal.ACKED.pack(index, at_s + 0.002)),
        ]
    blocks += [(p["host_time_s"][-1], Kind.TORQUE, p.tobytes()) for p in np.array_split(samples, n // 8)]
    end = {"outcome": "completed", "reason": "", "time_s": T0_S + long_s, "stimulation_end_s": T0_S + long_s}
    book = journal_at(path)
    widths_us = np.zeros(round(long_s * PULSE_HZ))
    widths_us[round(rest_s * PULSE_HZ) :] = 100.0 + np.arange(round(rest_s * PULSE_HZ), len(widths_us))
    segments = [{"name": "x", "start": 0, "end": len(widths_us), "by": "plan"}]
    head = {"recording_id": "7" * 32, "plan": PLAN, "segments": segments, "current_ma": 20.0, "software": "test"}
    book.begin(
        {**head, "sample_rate_hz": RATE_HZ, "configuration": {}, "time_s": 0.0, "unix_s": 0.0}, widths_us.tobytes()
    )
    for _, kind, payload in sorted(blocks, key=lambda block: block[0]):
        book.append(kind, payload)
    book.append_json(Kind.END, end)
    book.close()


def streamed(source: Path, copy: Path, test: LiveTest | None = None, upto: float = 1.0) -> list[Batch]:
    """Follow a copy that grows by pieces of any size; each piece is seen, however it cuts the blocks."""
    data, rng = source.read_bytes(), np.random.default_rng(0)
    test, batches, at, tail = test or LiveTest(), [], 0, None
    with copy.open("wb", buffering=0) as file:
        while at < int(len(data) * upto):
            step = int(rng.choice([1, 7, 300, 5000, 60000]))
            file.write(data[at : at + step])
            at += step
            tail = tail or Tail(copy)
            while blocks := tail.blocks():
                for kind, payload in blocks:
                    test.take(kind, payload)
            batches.append(test.ready())
            if test.ended:
                break
    assert tail is not None
    if not test.ended:
        batches.append(test.ready(finish=True))
    tail.close()
    return batches


def joined(batches: list[Batch]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Torque's times and values, pulses' times and values."""
    return (
        np.concatenate([batch.torque_s for batch in batches]),
        np.concatenate([batch.torque_nm for batch in batches]),
        np.concatenate([batch.pulse_s for batch in batches]),
        np.array([pulse for batch in batches for pulse in batch.pulses]).reshape(-1, 3),
    )


def assert_agrees(batches: list[Batch], recording: assembly.Recording, t0_s: float = T0_S, p99_s: float = 1e-3) -> None:
    """None lost, none doubled, none changed, and at the same times."""
    time_s, torque_nm, pulse_s, pulses = joined(batches)
    columns = recording.columns
    wanted_nm, wanted_s = columns["torque/torque_nm"], columns["torque/time_s"]
    first = next(i for i in range(100) if np.array_equal(torque_nm[i : i + 5], wanted_nm[:5]))
    assert np.array_equal(torque_nm[first : first + len(wanted_nm)], wanted_nm)
    assert len(torque_nm) - len(wanted_nm) <= 2 * (np.ceil(2 * MARGIN_S * RATE_HZ) + 2)
    assert np.all(np.diff(time_s) >= 0)
    apart_s = np.abs(time_s[first : first + len(wanted_s)] - t0_s - wanted_s)
    assert np.quantile(apart_s, 0.99) < p99_s
    written_s = columns["pulses/written_time_s"]
    sent = np.flatnonzero(np.isfinite(written_s))
    assert np.array_equal(pulses[:, 2], sent)
    assert np.array_equal(pulses[:, 0], columns["pulses/sent_pulse_width_us"][sent])
    assert np.array_equal(pulses[:, 1], columns["pulses/current_ma"][sent])
    assert pulse_s - t0_s == pytest.approx(written_s[sent], abs=1e-9)


@pytest.mark.parametrize(
    ("ppm", "cell", "rest_s"),
    [
        (0.0, {}, 0.6), (200.0, {}, 4.0), (-200.0, {"sync": False}, 0.6), (30.0, {"counter": False}, 4.0),
        (2000.0, {}, 0.6),
    ],
    ids=["exact", "slow", "no-sync", "no-counter", "far-off"],
)  # fmt: skip
def test_it_agrees_with_the_recording(tmp_path: Path, ppm: float, cell: dict[str, bool], rest_s: float):
    source = tmp_path / "t.journal"
    write_journal(source, 3, rest_s, 9.0, ppm, **cell)
    recording = assembly.assemble(journal.read(source))
    assert recording.alignment.method == ("sync" if cell.get("sync", True) else "regression")
    batches = streamed(source, tmp_path / "copy.journal")
    assert_agrees(batches, recording)
    marks = [mark for batch in batches for mark in batch.marks]
    assert [mark["event"] for _, mark in marks] == ["start", "end"]
    assert [time_s for time_s, _ in marks] == pytest.approx([T0_S, T0_S + 9.0])
    assert all((mark["participant"], mark["test_id"]) == ("P17", "t") for _, mark in marks)
    held_s = next(i for i, batch in enumerate(batches) if len(batch.torque_s))
    assert held_s < len(batches) - 2, "it was sent while the test ran"


def test_a_stopped_test_as_the_rig_plays_it(tmp_path: Path):
    rig = VirtualRig(tmp_path)
    rig.cell.noise_nm = 0.01
    rig.at(1.2, lambda: rig.halt.set("stopped", "enough"))
    assert rig.execute().outcome == "stopped"
    recording = rig.recording()
    batches = streamed(rig.path, tmp_path / "copy.journal")
    assert rig.run.t0_s is not None
    assert_agrees(batches, recording, rig.run.t0_s, p99_s=10e-3)  # this cell's sync line shows only each tenth sample
    assert batches[-1].marks[-1][1]["outcome"] == "stopped"


def test_a_rig_that_dies_leaves_what_it_had_written(tmp_path: Path):
    source, copy = tmp_path / "t.journal", tmp_path / "copy.journal"
    write_journal(source, 4, 0.6, 14.0)
    batches = streamed(source, copy, upto=0.7)
    contents = journal.read(copy)
    assert not contents.ended
    assert_agrees(batches, assembly.assemble(contents))
    assert [mark["event"] for batch in batches for _, mark in batch.marks] == ["start"]


def test_damage_costs_only_what_it_hit(tmp_path: Path):
    source = tmp_path / "t.journal"
    write_journal(source, 5, 0.6, 14.0)
    data, rng = bytearray(source.read_bytes()), np.random.default_rng(1)
    for at in rng.integers(40000, len(data) - 4000, 30):
        data[at] ^= 255
    source.write_bytes(bytes(data))
    recording = assembly.assemble(journal.read(source))
    batches = streamed(source, tmp_path / "copy.journal")
    time_s, torque_nm, _, pulses = joined(batches)
    kept = np.isin(recording.columns["torque/torque_nm"], torque_nm)
    assert np.all(kept)
    assert len(np.unique(pulses[:, 2])) == len(pulses) > 0.9 * 0.95 * 14 * PULSE_HZ
    assert np.all(np.diff(time_s) >= 0)


def test_one_that_joins_sends_only_what_comes_from_then_on(tmp_path: Path):
    source = tmp_path / "t.journal"
    write_journal(source, 6, 0.6, 9.0)
    whole = joined(streamed(source, tmp_path / "a.journal"))
    late = joined(streamed(source, tmp_path / "b.journal", test=LiveTest(since_s=T0_S + 5.0)))
    assert np.array_equal(late[1], whole[1][-len(late[1]) :])
    assert len(late[1]) == pytest.approx(4 * RATE_HZ, abs=100)
    assert late[2].min() >= T0_S + 5.0


def streaming_of(folder: Path) -> tuple[Streaming, list[Batch]]:
    """One that follows a rig's folder, and what it sends."""
    sent: list[Batch] = []
    (folder / "journals").mkdir()
    return Streaming(folder, SimpleNamespace(push=sent.append), 0.0, RATE_HZ, 1.0), sent  # pyright: ignore


@pytest.mark.parametrize(
    ("kind", "payload"),
    [(Kind.START, b"[]"), (Kind.HEADER, b"{}"), (Kind.TORQUE, b"abc"), (Kind.INTENT, b"ab"), (Kind.END, b"?")],
)
def test_a_block_of_nonsense_ends_nothing(tmp_path: Path, kind: Kind, payload: bytes):
    """Its check sum is right, its content is not: it is passed over, with one line."""
    streaming, sent = streaming_of(tmp_path)
    book = journal_at(tmp_path / "journals" / "t.journal")
    book.append(kind, payload)
    book.append_json(Kind.START, {"t0_s": T0_S})
    book.append_json(Kind.END, {"time_s": T0_S + 1.0, "outcome": "fault"})
    book.close()
    assert streaming.tick()
    assert [mark["event"] for batch in sent for _, mark in batch.marks] == ["start", "end"]
    streaming.close()


def test_one_whose_end_could_not_be_written_keeps_no_later_one_from_being_sent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """The disk was full: the journal lies there without an end, and cannot be sealed yet."""
    monkeypatch.setattr("stimrig.rig.lsl_outlets.streaming.LOOK_S", 0.0)
    streaming, sent = streaming_of(tmp_path)
    write_journal(tmp_path / "whole", 7, 0.6, 9.0)
    data = (tmp_path / "whole").read_bytes()
    (tmp_path / "journals" / "first.journal").write_bytes(data[: len(data) // 2])
    while streaming.tick():
        pass
    (tmp_path / "journals" / "second.journal").write_bytes(data)
    for _ in range(200):
        streaming.tick()
    marks = [mark["event"] for batch in sent for _, mark in batch.marks]
    assert marks == ["start", "start", "end"]
    whole = joined(streamed(tmp_path / "whole", tmp_path / "copy"))
    assert sum(len(batch.torque_s) for batch in sent) > 1.4 * len(whole[0])
    streaming.close()


def test_a_journal_left_by_a_crash_is_not_followed_a_growing_one_is(tmp_path: Path):
    (tmp_path / "old.journal").write_bytes(journal.MAGIC)
    folder = Journals(tmp_path)
    assert folder.following() is None
    with (tmp_path / "old.journal").open("ab") as file:
        file.write(b"more")
    assert folder.following() == tmp_path / "old.journal"
    assert folder.following() in folder.old
    folder.done(tmp_path / "old.journal")
    assert folder.following() is None
    (tmp_path / "new.journal").write_bytes(journal.MAGIC)
    assert folder.following() == tmp_path / "new.journal"
    assert tmp_path / "new.journal" not in folder.old
    assert Journals(tmp_path / "nowhere").following() is None


def test_a_tail_knows_when_its_journal_was_sealed_and_takes_no_lock(tmp_path: Path):
    book = journal_at(tmp_path / "t.journal")
    tail = Tail(book.path)
    book.append_json(Kind.HEADER, {"a": 1})
    assert [(kind, json.loads(payload)) for kind, payload in tail.blocks()] == [(Kind.HEADER, {"a": 1})]
    assert not tail.left()
    locks = Path("/proc/locks").read_text().splitlines()
    assert sum(str(book.path.stat().st_ino) in line for line in locks) <= 1  # the rig's own
    book.close()
    book.path.unlink()
    assert tail.left()
    tail.close()


def test_where_a_reader_could_hold_up_the_writer_nothing_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("stimrig.rig.lsl_outlets.streaming.FREE_TO_READ", {1: "none"})
    with pytest.raises(RecordingError, match="may hold up the rig"):
        refuse_locking(tmp_path)
    with pytest.raises(RecordingError, match="nowhere"):
        refuse_locking(tmp_path / "nowhere")


def test_each_pulse_tells_its_channel(tmp_path: Path):
    rig = two(tmp_path)
    rig.execute()
    test = LiveTest()
    for kind, payload in journal.read(rig.path).blocks:
        test.take(kind, payload)
    batch = test.ready(finish=True)
    assert len(batch.pulses) == 80
    assert batch.channels == [0, 1] * 40
    assert [pulse[1] for pulse in batch.pulses[:2]] == [20.0, 30.0]


@pytest.mark.parametrize("several", [False, True])
def test_the_stream_has_one_more_channel_where_there_are_several(several: bool):
    pushed: list[np.ndarray] = []
    labels: list[int] = []

    class Outlet:
        def __init__(self, info: object) -> None: ...

        def push_chunk(self, values: np.ndarray, _times_s: list[float]) -> None:
            pushed.append(values)

    def info(_name: str, kind: str, count: int, *_: object) -> SimpleNamespace:
        if kind == "Stimulation":
            labels.append(count)
        return SimpleNamespace(desc=Mock)

    lsl = SimpleNamespace(cf_double64=0, cf_string=1, StreamInfo=info, StreamOutlet=Outlet)
    streams = Outlets(lsl, 1000.0, {}, several=several)
    streams.push(Batch(pulse_s=[1.0, 2.0], pulses=[(100.0, 20.0, 5), (90.0, 30.0, 6)], channels=[0, 1]))
    assert labels == [4 if several else 3]
    assert pushed[0].tolist() == ([[100, 20, 5, 0], [90, 30, 6, 1]] if several else [[100, 20, 5], [90, 30, 6]])
