"""A test that is extended while it plays: what is written, when, and what is left of a damaged journal."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stimrig.rig import archive, assembly, journal
from stimrig.rig.errors import JournalError, RecordingError
from stimrig.rig.journal import Kind, LaidBlock
from stimrig.rig.signals import PulseStatus
from tests.rig.adaptive import adaptive, extend, hold, refusals, widths_sent
from tests.rig.test_damaged import blocks_of


def test_each_segment_is_in_the_journal_before_its_first_pulse(tmp_path: Path):
    rig = adaptive(tmp_path)
    rig.at(0.2, lambda: extend(rig, 20, [hold("added")]))
    rig.at(1.7, lambda: rig.run.score.enough("me", at_once=True))
    rig.execute()
    laid_to, seen = 20, []
    for kind, payload in journal.read(rig.path).blocks:
        if kind == Kind.LAID:
            block = LaidBlock.of_bytes(payload)
            assert len(block.pulse_width_us) == block.segment.end - block.segment.start
            laid_to = block.segment.end
            seen.append(block.segment.by)
        elif kind == Kind.INTENT:
            assert journal.INTENT.unpack(payload)[0] < laid_to
    assert seen == ["extension", "plan", "end"]


def test_a_disk_that_takes_no_segment_ends_it_as_a_fault(tmp_path: Path):
    rig = adaptive(tmp_path)
    rig.at(0.2, lambda: setattr(rig.journal, "_failure", "disk full"))
    rig.at(0.3, lambda: refusals(lambda: extend(rig, 20, [hold()])))
    result = rig.execute()
    assert (result.outcome, result.reason, rig.stimulator.sent) == ("fault", "disk full", [])
    (tmp_path / "2").mkdir()
    rig = adaptive(tmp_path / "2")
    rig.journal._failure = "disk full"
    with pytest.raises(JournalError):
        extend(rig, 20, [hold()])
    assert len(rig.run.score.laid) == 20


@pytest.mark.slow
def test_a_journal_cut_anywhere_or_without_a_laid_block_loses_no_pulse(tmp_path: Path):
    rig = adaptive(tmp_path)
    rig.at(0.2, lambda: extend(rig, 20, [hold("added", max_pulse_width_us=150.0)]))
    rig.at(1.8, lambda: rig.run.score.enough("me", at_once=True))
    rig.execute()
    whole = rig.path.read_bytes()
    copy, acknowledged = tmp_path / "copy.journal", []
    for end in np.linspace(0, len(whole), 25).astype(int):
        copy.write_bytes(whole[:end])
        try:
            contents = journal.read(copy)
            recording = assembly.assemble(contents, "fault", "killed")
        except RecordingError as error:
            assert end < 9000, error  # header and plan
            continue
        columns = recording.columns
        assert recording.attributes["outcome"] == ("completed" if contents.ended else "fault")
        told, intents = (sum(kind == of for kind, _ in contents.blocks) for of in (Kind.ACKED, Kind.INTENT))
        assert np.sum(columns["pulses/status"] == PulseStatus.ACKNOWLEDGED) == told
        assert np.sum(np.nan_to_num(columns["pulses/current_ma"]) > 0) == intents
        assert np.sum(np.nan_to_num(columns["pulses/sent_pulse_width_us"]) > 0) == intents
        assert np.all(np.isfinite(columns["torque/time_s"]))
        assert len({len(column) for path, column in columns.items() if path.startswith("pulses/")}) == 1
        acknowledged.append(told)
        archive.to_bytes(recording)
    assert acknowledged == sorted(acknowledged) and acknowledged[-1] > 50
    at = blocks_of(whole, Kind.LAID)
    assert len(at) == 3
    for lost in ([0], [1], [2], [0, 1], [0, 1, 2]):
        spoiled = bytearray(whole)
        for number in lost:
            spoiled[at[number] + 20] ^= 255
        copy.write_bytes(spoiled)
        recording = assembly.assemble(journal.read(copy))
        sent = recording.columns["pulses/sent_pulse_width_us"]
        assert np.nan_to_num(sent)[np.nan_to_num(sent) > 0].tolist() == widths_sent(rig)
        assert "journal is damaged" in recording.attributes["journal_note"]
        if 0 in lost:
            assert "which segments pulses 21 to" in recording.attributes["journal_note"]
            assert "added" not in recording.names
