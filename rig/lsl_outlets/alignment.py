"""The alignment of `stimrig.rig.align` while the samples still come: of all samples so far, kept as few points.

The sealed recording's alignment uses the whole test. A line through its first second errs most far away from it, so the
first samples are held back until the line is known well enough (`error_s`).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stimrig.rig import align
from stimrig.rig.align import Array, Line

WINDOW_S = 0.5
"""The earliest sample of each such stretch is kept for the envelope, as `stimrig.rig.align.earliest` does."""
IN_TRANSIT_S = 0.1
"""Real seconds: edges and pulses newer than this are not compared, one of a pair may still be on its way."""
NO_SYNC = 255


class LiveAlignment:
    """Grows with the test.

    Parameters
    ----------
    sample_rate_hz
        Nominal rate of the cell.
    speed
        Rig seconds per real second.
    """

    def __init__(self, sample_rate_hz: float, speed: float = 1.0) -> None:
        self._rate_hz, self._speed = sample_rate_hz, speed
        self._kind, self._counted, self._first_stamp_s = "", 0, 0.0
        self._window = -1
        self._earliest: list[tuple[float, float]] = []
        self._last = np.empty(0), np.empty(0, np.uint8)
        self._edges_s: list[float] = []
        self._written_s: list[float] = []
        self._newest_s = -np.inf
        self.synced = self.paired = False
        self.line: Line | None = None
        self._span_s = 0.0

    def samples(self, samples: NDArray[Any]) -> Array:
        """Take the next samples (`stimrig.rig.signals.SAMPLE`); their times on the cell's clock, s."""
        cell_s, host_s = self._cell_s(samples), samples["host_time_s"]
        self._newest_s = max(self._newest_s, float(host_s[-1]))
        windows = np.floor(cell_s / WINDOW_S).astype(np.int64)
        for window in np.unique(windows):
            inside = np.flatnonzero(windows == window)
            best = inside[np.argmin(host_s[inside] - cell_s[inside])]
            self._offer(int(window), float(cell_s[best]), float(host_s[best]))
        sync = samples["sync"]
        self.synced = self.synced or bool(np.any(sync != NO_SYNC))
        if self.synced:
            both_s, both = np.append(self._last[0], cell_s), np.append(self._last[1], sync)
            self._edges_s.extend(align.rising_edges(both_s, both, self._rate_hz).tolist())
            self._last = both_s[-1:], both[-1:]
        return cell_s

    def pulse(self, written_s: float) -> None:
        """Take the next pulse that was written, by its time on the rig's clock, s."""
        self._written_s.append(written_s)

    def update(self) -> None:
        """Fit the line anew."""
        points = np.array(self._earliest)
        if len(points) == 0:
            return
        envelope = align.line_below(points[:, 0], points[:, 1])
        pairs = self._pairs(envelope)
        if pairs is None:
            self.line, self._span_s = envelope, float(np.ptp(points[:, 0]))
        else:
            self.line, self._span_s = align.robust_line(*pairs), float(np.ptp(pairs[0]))
        self.paired = pairs is not None

    def error_s(self, cell_s: float) -> float:
        """Standard error of the line at a time of the cell's clock, s; infinite where too little is known."""
        if self.line is None or self._span_s <= 0 or (self.synced and not self.paired):
            return np.inf
        count = len(self._edges_s) if self.paired else len(self._earliest)
        # the scatter of few points may be nothing by chance; a sample's length scatters at least
        least_s = 1 / self._rate_hz / np.sqrt(12 * count)
        lever = np.sqrt(12) * (cell_s - self.line.centre_s) / self._span_s
        error_s = max(self.line.error_s, least_s) * np.hypot(1, lever)
        return float(error_s) if np.isfinite(error_s) else np.inf

    def _pairs(self, envelope: Line) -> tuple[Array, Array] | None:
        until_s = self._newest_s - IN_TRANSIT_S * self._speed
        edges_s, written_s = np.array(self._edges_s), np.array(self._written_s)
        edges_s, written_s = edges_s[envelope.at(edges_s) < until_s], written_s[written_s < until_s]
        found = align.paired(edges_s, written_s, envelope)
        if found is None or len(found[0]) < align.MIN_EDGES:
            return None
        return found[0], found[1]

    def _offer(self, window: int, cell_s: float, host_s: float) -> None:
        if window != self._window:
            self._window = window
            self._earliest.append((cell_s, host_s))
        elif host_s - cell_s < self._earliest[-1][1] - self._earliest[-1][0]:
            self._earliest[-1] = cell_s, host_s

    def _cell_s(self, samples: NDArray[Any]) -> Array:
        """`stimrig.rig.align.cell_time`, block by block: what the first block has tells what is counted by."""
        counter, stamp_s = samples["counter"], samples["stamp_s"]
        if not self._kind:
            self._kind = "counter" if np.all(counter >= 0) else "stamp" if np.all(np.isfinite(stamp_s)) else "count"
            self._first_stamp_s = float(stamp_s[0])
        if self._kind == "counter":
            return align.cell_time(counter.astype(np.int64), stamp_s, self._rate_hz)
        if self._kind == "stamp":
            return stamp_s - self._first_stamp_s
        cell_s = (self._counted + np.arange(len(samples))) / self._rate_hz
        self._counted += len(samples)
        return cell_s
