"""What a fake rig lays: the fixed test, or an adaptive one that grows as a client extends it."""

from __future__ import annotations

from typing import Any

from stimrig.rig import messages as m

PULSE_RATE_HZ = 40.0
AHEAD_S = 0.05


class FakeScore:
    """Widths, µs, and segments that are laid; an adaptive plan holds only lists of widths."""

    def __init__(self, plan: m.TestPlan, widths: list[float], segments: list[dict[str, Any]]) -> None:
        self.adaptive, self.ended_by, self.refuses = plan.adaptive, "" if plan.adaptive else "plan", ""
        self.fixed = (
            [(s.name, list(s.settings["pulse_width_us"])) for s in plan.segments or []] if self.adaptive else []
        )
        self.widths, self.segments = ([], []) if self.adaptive else (widths, segments)
        if self.adaptive:
            self.lay(*self.fixed.pop(0), by="plan")

    @property
    def end_s(self) -> float:
        return len(self.widths) / PULSE_RATE_HZ

    def lay(self, name: str, widths: list[float], by: str) -> None:
        start = self.end_s
        self.widths = [*self.widths, *widths]
        self.segments = [*self.segments, {"name": name, "start_s": start, "end_s": self.end_s, "by": by}]

    def go_on(self, now_s: float) -> None:
        """Lay the next of the fixed plan where nobody did in time."""
        while not self.ended_by and now_s > self.end_s - AHEAD_S:
            if self.fixed:
                self.lay(*self.fixed.pop(0), by="plan")
            else:
                self.end("plan")

    def extend(self, after: int, chosen: list[m.SegmentPlan]) -> str:
        """The problem's code, or nothing."""
        if self.ended_by or after != len(self.widths):
            return "late"
        for segment in chosen:
            self.lay(segment.name, list(segment.settings["pulse_width_us"]), by="extension")
        return ""

    def end(self, by: str, at_s: float | None = None) -> None:
        kept = len(self.widths) if at_s is None else min(len(self.widths), round(at_s * PULSE_RATE_HZ) + 1)
        self.widths, self.ended_by = self.widths[:kept], by
        self.segments = [
            {**s, "end_s": min(s["end_s"], self.end_s)} for s in self.segments if s["start_s"] < self.end_s
        ]
        self.lay("rest", [0.0] * round(PULSE_RATE_HZ), by="end")

    def told(self, test_id: str) -> dict[str, Any]:
        return m.Extended(
            test_id=test_id, laid=len(self.widths), boundary_s=self.end_s, ended_by=self.ended_by,
            duration_left_s=0.0, charge_left_uc=0.0, torque_time_left_nms=0.0,
        ).model_dump()  # fmt: skip

    def live(self) -> dict[str, Any]:
        """Of a live event."""
        laid = [m.LaidSegment(**s) for s in self.segments] if self.adaptive else []
        return {"laid": len(self.widths), "boundary_s": self.end_s, "ended_by": self.ended_by, "laid_segments": laid}
