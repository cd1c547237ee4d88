"""The journal: whatever is cut or damaged, everything else comes back, and what was felt is told or said to be lost."""

from __future__ import annotations

import fcntl
import itertools
import json
import os
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from stimrig.api.cli import main
from stimrig.rig import archive, assembly, journal, recover
from stimrig.rig.adapters.files import Files
from stimrig.rig.assembly import _Pulses
from stimrig.rig.control.sealing import RecordingStore
from stimrig.rig.errors import BusyError, JournalError, RecordingError
from stimrig.rig.journal import JournalContents, Kind
from stimrig.rig.messages import SegmentPlan
from tests.rig.fakes import VirtualRig, header, journal_at
from tests.rig.live import ACK_S, SPEED, LiveRig
from tests.simulator.disk import SimulatedDisk
from tests.simulator.virtual_time import VirtualMachine
from tests.simulator.world import World

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
SECTOR = 4096
FELT = (0, 4, 5)
PLAYED = [
    SegmentPlan(name="rest", sequence="rest", settings={"duration_s": 0.3}),
    SegmentPlan(name="prbs", sequence="prbs", settings={"bits": 5, "clock_pulses": 4}),
]


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> tuple[bytes, int, float]:
    """A test's journal as the rig writes it, how many pulses were felt, and their charge."""
    rig = VirtualRig(tmp_path_factory.mktemp("played"), PLAYED)
    rig.journal.close()
    rig.path.unlink()
    book = journal_at(rig.path)
    book.begin(header(rig.run, rig.clock), rig.test.pulse_width_us.astype("<f8").tobytes())
    rig.journal = rig.run.journal = book
    assert rig.execute().outcome == "completed"
    felt = [pulse for _, pulse in rig.stimulator.sent]
    assert len(felt) > 50
    return rig.path.read_bytes(), len(felt), sum(pulse.charge_uc for pulse in felt)


def sealed(tmp_path: Path, data: bytes) -> assembly.Recording:
    (tmp_path / "t.journal").write_bytes(data)
    return assembly.assemble(journal.read(tmp_path / "t.journal"))


def felt(recording: assembly.Recording) -> tuple[int, float]:
    """Pulses that were sent or may have been, and their charge."""
    columns = recording.columns
    sent = np.isin(columns["pulses/status"], FELT)
    charge_uc = columns["pulses/sent_pulse_width_us"] * columns["pulses/current_ma"] * 1e-3
    return int(np.sum(sent)), float(np.nansum(charge_uc[sent]))


def blocks_of(data: bytes, *kinds: Kind) -> list[int]:
    found, at = [], len(journal.MAGIC)
    while at < len(data):
        block = journal.block_at(data, at)
        assert block is not None
        if block[0] in kinds:
            found.append(at)
        at = block[3]
    return found


def test_one_flipped_bit_anywhere_loses_no_pulse(tmp_path: Path, played: tuple[bytes, int, float]):
    data, pulses, charge_uc = played
    rng = np.random.default_rng(9)
    spacer = blocks_of(data, Kind.SPACER)[0]
    copies = [*range(spacer), *range(spacer + journal.APART_BYTES, blocks_of(data, Kind.START)[0])]
    places = {*rng.choice(copies, 30).tolist(), *rng.integers(len(data), size=50).tolist(), *range(24)}
    for at in sorted(places):
        spoiled = bytearray(data)
        spoiled[at] ^= 1 << int(rng.integers(8))
        recording = sealed(tmp_path, bytes(spoiled))
        assert felt(recording) == (pulses, pytest.approx(charge_uc)), at
        assert recording.attributes["participant"] == "P"
        assert "damaged" in recording.attributes["journal_note"]


def test_a_sector_that_is_gone_loses_no_pulse(tmp_path: Path, played: tuple[bytes, int, float]):
    data, pulses, charge_uc = played
    for at in range(0, len(data), SECTOR * 3 // 4):
        spoiled = data[:at] + bytes(min(SECTOR, len(data) - at)) + data[at + SECTOR :]
        recording = sealed(tmp_path, spoiled)
        found, found_uc = felt(recording)
        note = recording.attributes["journal_note"]
        assert found >= pulses or "blocks are missing" in note, at
        if at + SECTOR < len(data):  # not at the tail, where a cut and a damage look the same
            assert found >= pulses, (at, note)
            assert found_uc >= charge_uc - 1e-6, (at, note)
        assert recording.attributes["participant"] == "P"


@pytest.mark.parametrize(
    ("kinds", "words"),
    [
        ((Kind.HEADER,), "both copies of the header are lost"),
        ((Kind.PLAN,), "both copies of the plan are lost"),
        ((Kind.HEADER, Kind.PLAN), "both copies of the plan are lost"),
        ((Kind.HEADER, Kind.PLAN, Kind.START, Kind.END), "both copies of the header are lost"),
        ((Kind.INTENT,), "pulses were sent whose intents are lost"),
        ((Kind.INTENT, Kind.PLAN), "the width of"),
        ((Kind.INTENT, Kind.WRITTEN, Kind.ACKED), "planned pulses have no block"),
        ((Kind.START,), "damaged"),
        ((Kind.END,), "damaged"),
    ],
)
def test_with_whole_kinds_of_blocks_lost_the_others_tell(
    tmp_path: Path, played: tuple[bytes, int, float], kinds: tuple[Kind, ...], words: str
):
    data, pulses, charge_uc = played
    spoiled = bytearray(data)
    for at in blocks_of(data, *kinds):
        spoiled[at + 12] ^= 0xFF
    recording = sealed(tmp_path, bytes(spoiled))
    assert words in recording.attributes["journal_note"]
    found, found_uc = felt(recording)
    assert found == pulses
    if kinds != (Kind.INTENT, Kind.PLAN):  # which alone leave the widths unknown
        assert found_uc == pytest.approx(charge_uc)
    assert recording.attributes["pulse_rate_hz"] == pytest.approx(40.0)
    assert len(recording.columns["torque/time_s"]) > 1000
    assert recording.attributes["test_id"] == "t"
    assert archive.seal(recording, tmp_path, Files()).path.is_file()


def test_it_is_never_said_that_no_pulse_was_sent_beside_what_cannot_be_read(tmp_path: Path):
    (tmp_path / "j").write_bytes(journal.MAGIC + b"\xa5BLK" + b"x" * 400)
    with pytest.raises(RecordingError, match="404 bytes cannot be read, and the rest contains no pulse") as told:
        assembly.assemble(journal.read(tmp_path / "j"))
    assert "no pulse was sent" not in str(told.value)
    (tmp_path / "k").write_bytes(journal.MAGIC)
    with pytest.raises(RecordingError, match="ends before its plan, so no pulse was sent"):
        assembly.assemble(journal.read(tmp_path / "k"))


def test_the_two_copies_lie_further_apart_than_a_sector(played: tuple[bytes, int, float]):
    headers = blocks_of(played[0], Kind.HEADER)
    plans = blocks_of(played[0], Kind.PLAN)
    first_end, second = blocks_of(played[0], Kind.SPACER)[0], headers[1]
    assert (len(headers), len(plans)) == (2, 2)
    assert second - first_end > SECTOR


def test_recover_seals_says_what_is_missing_and_leaves_the_journal(
    tmp_path: Path,
    played: tuple[bytes, int, float],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
):
    def recovered(*words: str, run: Callable[[list[str]], int] = recover.main) -> tuple[int, str, str]:
        code = run([*words])
        return code, *capsys.readouterr()

    monkeypatch.chdir(ROOT)
    data, pulses, _ = played
    spoiled = bytearray(data)
    for at in blocks_of(data, Kind.HEADER):
        spoiled[at] ^= 1
    for name in ("journals", "recordings"):
        (tmp_path / name).mkdir()
    path = tmp_path / "journals" / "t.unsealed"
    path.write_bytes(spoiled)
    code, out, _ = recovered("recover", str(path), "--json", run=main.run)
    found = json.loads(out)
    assert (code, found["pulses"], found["test_id"], found["participant"]) == (0, pulses, "t", "unknown")
    assert "both copies of the header are lost" in found["note"]
    assert path.read_bytes() == spoiled
    with h5py.File(found["recording"]) as file:
        assert file.attrs["recording_id"] == found["recording_id"]
        assert file.attrs["journal_note"] == found["note"]
    assert Path(found["recording"]).parent == tmp_path / "recordings"
    code, out, _ = recovered(str(path))
    assert code == 0 and "already sealed" in out
    path.write_bytes(data[: len(data) // 2])
    other = Path(found["recording"]).with_name(archive.place(assembly.assemble(journal.read(path)), path).name)
    other.write_bytes(Path(found["recording"]).read_bytes())
    code, _, err = recovered(str(path))
    assert code == 2 and "another recording of this test exists" in err
    (tmp_path / "noise").write_bytes(b"no journal")
    for wrong, run, words in (("noise", recover.main, []), ("nowhere", main.run, ["recover", "--"])):
        code, out, err = recovered(*words, str(tmp_path / wrong), run=run)
        assert (code, out, len(err.splitlines())) == (2, "", 1)
        assert err.removeprefix("stimrig ").startswith("recover: journal ")


def test_recover_refuses_what_a_living_rig_has(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    rig = VirtualRig(tmp_path)
    assert recover.main([str(rig.path)]) == 2
    assert "a running rig uses it" in capsys.readouterr().err
    rig.journal.close()
    (tmp_path / "journals").mkdir(exist_ok=True)
    path = rig.path.rename(tmp_path / "journals" / "t.journal")
    with Files().lock(tmp_path):
        assert recover.main([str(path)]) == 2
        assert "a running rig uses it" in capsys.readouterr().err
    assert recover.main([str(path)]) == 0


def test_a_sender_that_lost_the_processor_wrote_before_the_ack() -> None:
    """The ack of pulse 0 was read before the sender could look at its clock, that of 1 as usual, of 2 never."""
    blocks: list[tuple[Kind, bytes]] = []
    for index, (written_s, acked_s) in enumerate([(10.0042, 10.0013), (10.0251, 10.0262), (10.0503, None)]):
        blocks.append((Kind.INTENT, journal.INTENT.pack(index, 10.0 + 0.025 * index, 0.0, 120.0, 20.0)))
        blocks.append((Kind.WRITTEN, journal.WRITTEN.pack(index, index, written_s)))
        if acked_s is not None:
            blocks.append((Kind.ACKED, journal.ACKED.pack(index, acked_s)))
    pulses = _Pulses(np.full(3, 120.0), 20.0, 10.0)
    pulses.add(JournalContents(Path("j"), blocks, 0, 0))
    columns = pulses.columns(40.0, 0.075, blocks_missing=False, notes=[])
    expected_s = [0.0013, 0.0251, 0.0503]
    np.testing.assert_allclose(columns["pulses/written_time_s"], expected_s, atol=1e-9)


Make = Callable[..., LiveRig]
PULSES = 10


def died(
    make: Make, cut: Kind | None = None, acknowledged: bool = True, boot_id: str = "this-boot"
) -> tuple[list[float], dict[str, Any]]:
    """Charge of each pulse that was felt as a process died, µC, and what the next one tells; `cut`: its last block of
    that kind, and what came after it, was not written any more."""
    live = make(disk=SimulatedDisk(World(0)))
    disk: Any = live.machine.disk
    live.machine.boot_id = boot_id
    live.start(live.plan("one", hold_s=20.0))
    live.wait_pulses(PULSES)
    live.machine.wait(2 * ACK_S if acknowledged else 0.0)
    felt_uc = [pulse.charge_uc for _, pulse in live.stimulator.sent]
    file = disk.files[live.config.data_dir / "journals" / "one.journal"]
    if cut is not None:
        data = bytes(file.data)
        places = [i for i in range(len(data)) if (block := journal.block_at(data, i)) is not None and block[0] == cut]
        del file.data[places[-1] :]
    assert live.rig.player.run is not None
    live.rig.player.run.journal._failure = "dead"  # nothing of that process is written any more
    disk.process_ended()
    again = make(disk=disk, clock=live.clock)
    assert again.rig.status().state == "uncertain"
    return felt_uc, again.finished.summary


def test_a_second_rig_whose_lock_was_removed_does_not_touch_a_journal_that_is_written(make: Make, tmp_path: Path):
    live = make(disk=SimulatedDisk(World(0)))
    disk: Any = live.machine.disk
    live.start(live.plan("one", hold_s=1.0))
    live.wait_pulses(PULSES)
    disk._locked = False  # somebody moved the journals' folder away and back as a copy
    with pytest.raises(BusyError, match="another rig writes it"):
        make(disk=disk, clock=live.clock)
    live.wait("ready")
    assert (live.finished.outcome, live.finished.summary["warnings"]) == ("completed", [])
    path = tmp_path / "one.journal"
    log = Files().create(path)
    assert Files().is_written(path)
    log.close()
    assert not Files().is_written(path)


@pytest.mark.parametrize(
    ("cut", "acknowledged", "doubtful"), [(None, True, 0), (None, False, 1), (Kind.WRITTEN, False, 1)]
)
def test_what_the_journal_knows_is_told_and_a_pulse_that_is_in_doubt_counts(
    make: Make, cut: Kind | None, acknowledged: bool, doubtful: int
):
    felt_uc, summary = died(make, cut, acknowledged)
    assert summary["recovered"] is True
    assert summary["pulses"] == PULSES and summary["charge_uc"] == pytest.approx(sum(felt_uc))
    assert 0.5 + (PULSES - 1) / 40 <= summary["duration_s"] < 1.5
    assert summary["torque_time_nms"] > 0 and summary["torque_peak_nm"] > 0
    assert (summary["doubtful_pulses"], summary["dose_is_bound"]) == (doubtful, doubtful > 0)
    told = [words for words in summary["warnings"] if words.startswith("dose: of ")]
    assert len(told) == (doubtful > 0)


def test_after_a_power_failure_what_the_disk_may_have_lost_counts(make: Make):
    """The journal is synced twice a second, and a disk that takes none for 3 s ends the test."""
    felt_uc, summary = died(make, boot_id="the boot before")
    lost = summary["pulses"] - PULSES
    assert lost == pytest.approx(3.5 * SPEED * 40, abs=2)
    assert summary["charge_uc"] == pytest.approx(sum(felt_uc) + lost * felt_uc[-1])
    assert summary["dose_is_bound"] is True and summary["doubtful_pulses"] >= lost


BLOCKS = [(Kind.HEADER, b'{"a": 1}'), (Kind.PLAN, b""), (Kind.TORQUE, bytes(range(200))), (Kind.END, b"{}")]


def written(path: Path) -> bytes:
    book = journal_at(path)
    for kind, payload in BLOCKS:
        book.append(kind, payload)
    book.close()
    return path.read_bytes()


def test_after_an_error_of_the_disk_it_is_closed_all_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    book = journal_at(tmp_path / "j")
    with monkeypatch.context() as full:
        full.setattr(os, "write", lambda *_: 0)
        with pytest.raises(JournalError):
            book.append(Kind.PLAN, b"abc")
    book.close()
    with (tmp_path / "j").open() as file:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # nobody holds it any more


def test_a_start_that_the_disk_refuses_leaves_no_journal(make: Callable[..., LiveRig], tmp_path: Path):
    live = make(disk=(disk := SimulatedDisk(World(0))))
    disk.access = lambda: setattr(disk, "free", 1000)
    with pytest.raises(JournalError):
        live.start(live.plan("refused"))
    assert not any(path.suffix == ".journal" for path in disk.files)


def test_cut_anywhere_only_the_tail_is_lost(tmp_path: Path):
    whole = written(tmp_path / "j")
    ends = [len(journal.MAGIC)]
    for _, payload in BLOCKS:
        ends.append(ends[-1] + 16 + len(payload))
    for length in range(len(journal.MAGIC), len(whole) + 1):
        cut = tmp_path / "cut"
        cut.write_bytes(whole[:length])
        contents = journal.read(cut)
        assert contents.blocks == BLOCKS[: sum(length >= end for end in ends[1:])]
    assert contents.blocks == BLOCKS and contents.ended
    assert (contents.damaged_bytes, contents.blocks_missing) == (0, 0)
    assert contents.first_json(Kind.HEADER) == {"a": 1}
    assert contents.first_json(Kind.START) is None


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(data=st.data())
def test_damage_costs_the_damaged_block_only(tmp_path: Path, data: st.DataObject):
    path = tmp_path / "j"
    path.unlink(missing_ok=True)
    whole = bytearray(written(path))
    at = data.draw(st.integers(len(journal.MAGIC), len(whole) - 1))
    whole[at] ^= 1 << data.draw(st.integers(0, 7))
    path.write_bytes(whole)
    contents = journal.read(path)
    assert contents.damaged_bytes > 0
    ends = itertools.accumulate((16 + len(payload) for _, payload in BLOCKS), initial=len(journal.MAGIC))
    hit = sum(at >= end for end in ends) - 1
    assert contents.blocks == BLOCKS[:hit] + BLOCKS[hit + 1 :]


def test_a_full_disk_is_told_and_nothing_follows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    book = journal_at(tmp_path / "j")
    book.append(Kind.EVENT, b"1")
    real = os.write
    monkeypatch.setattr(os, "write", lambda fd, data: real(fd, data[: len(data) // 2]))
    with pytest.raises(JournalError, match="the test stops"):
        book.append(Kind.EVENT, b"2")
    monkeypatch.setattr(os, "write", real)
    with pytest.raises(JournalError):
        book.append(Kind.EVENT, b"3")
    book.close()
    contents = journal.read(tmp_path / "j")
    assert contents.blocks == [(Kind.EVENT, b"1")]


def test_mistakes_are_named(tmp_path: Path):
    with pytest.raises(RecordingError, match="No such file"):
        journal.read(tmp_path / "none")
    (tmp_path / "other").write_bytes(b"hello")
    with pytest.raises(RecordingError, match="is not a journal"):
        journal.read(tmp_path / "other")
    journal_at(tmp_path / "j").close()
    store = RecordingStore(SimpleNamespace(data_dir=tmp_path), VirtualMachine())
    with pytest.raises(JournalError, match="File exists"):
        store._create(tmp_path / "j")
