"""Journal in, columns of a recording out."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stimrig.rig import journal
from stimrig.rig.assembly import _Pulses
from stimrig.rig.journal import JournalContents, Kind


def test_a_sender_that_lost_the_processor_wrote_before_the_ack() -> None:
    """The ack of pulse 0 was read before the sender could look at its clock, that of 1 as usual, of 2 never."""
    blocks: list[tuple[Kind, bytes]] = []
    for index, (written_s, acked_s) in enumerate([(10.0042, 10.0013), (10.0251, 10.0262), (10.0503, None)]):
        blocks.append((Kind.INTENT, journal.INTENT.pack(index, 10.0 + 0.025 * index, 0.0, 120.0, 20.0)))
        blocks.append((Kind.WRITTEN, journal.WRITTEN.pack(index, index, written_s)))
        if acked_s is not None:
            blocks.append((Kind.ACKED, journal.ACKED.pack(index, acked_s)))
    pulses = _Pulses(np.full(3, 120.0), 20.0, 10.0)
    pulses.take(JournalContents(Path("j"), blocks, 0, 0))
    columns = pulses.columns(40.0, 0.075, blocks_missing=False, notes=[])
    expected_s = [0.0013, 0.0251, 0.0503]
    np.testing.assert_allclose(columns["pulses/written_time_s"], expected_s, atol=1e-9)
