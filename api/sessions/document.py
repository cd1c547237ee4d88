"""A test as clients see it: by REST, over the live channel, on the pages."""

from __future__ import annotations

from typing import Any

from stimrig.api.sessions.adaptive_tests import AdaptiveTests
from stimrig.api.sessions.joint_tests import JointTests
from stimrig.api.sessions.lifecycle import Lifecycle
from stimrig.api.sessions.live import Hub
from stimrig.api.store.tables import OPEN_STATES, Test

TOLD = (
    "id", "participant", "kind", "reason", "requested_by", "requested_utc", "finished_utc", "recording_id", "model_id"
)  # fmt: skip
"""What is told of its row as it is."""
KEPT = ("adaptive", "joint")
"""What is kept with a summary, and told beside it."""


def of(row: Test, hub: Hub, lifecycle: Lifecycle, adaptive: AdaptiveTests, joint: JointTests) -> dict[str, Any]:
    """What became of it so far; while it runs also where it is, as the rig tells it."""
    planned = {key: value for key, value in row.plan.get("preview", {}).items() if key != "pulse_width_us"}
    running = row.state in ("requested", "running")
    start = (0.0, planned.get("duration_s", 0.0), None)
    end = (row.summary.get("duration_s", 0.0), row.summary.get("duration_s", 0.0), None)
    elapsed_s, duration_s, segment = (hub.position(row.id) or start) if running else end
    call, rig = lifecycle.calls.get(row.id), lifecycle.rig.status
    sealing = running and rig is not None and rig.test_id == row.id and rig.state == "sealing"
    model = lifecycle.versions.get(row.model_id) if row.model_id else None
    return {
        **{name: getattr(row, name) for name in TOLD},
        "state": "sealing" if sealing else row.state,
        "done": row.state not in OPEN_STATES,
        "segment": segment,
        "elapsed_s": elapsed_s,
        "duration_s": duration_s,
        "time_left_s": max(0.0, duration_s - elapsed_s),
        "progress": min(1.0, elapsed_s / duration_s) if duration_s else 0.0,
        "identification": call.document() if call else None,
        "ran_by": row.ran_by or row.requested_by,
        **{name: row.plan.get(name) for name in ("side", "muscle", "joins")},
        "planned": planned,
        "recording_url": f"/v1/recordings/{row.recording_id}" if row.recording_id else None,
        "model_url": f"/v1/models/{row.model_id}" if row.model_id else None,
        "summary": {name: value for name, value in row.summary.items() if name not in KEPT},
        "adaptive": adaptive.document(row),
        "joint": joint.document(row),
        "fit": lifecycle.versions.document(model) if model else None,
    }
