"""A controller's day with the client that openapi-python-client made; prints what it saw as JSON."""

# pyright: basic, reportMissingImports=false
from __future__ import annotations

import json
import sys
import time

from made import AuthenticatedClient
from made.api.models import approved_model, one_model, prediction, tracking, widths
from made.api.participants import one_participant
from made.api.recordings import recording
from made.api.rig import stop
from made.api.tests import one_test, start_test
from made.models import ReferenceIn, TestIn, WidthsIn

url, token, code = sys.argv[1:4]
reference_nm = [0.0] * 20 + [0.5] * 60 + [0.0] * 20
with AuthenticatedClient(base_url=url, token=token, timeout=60) as client:
    first = approved_model.sync_detailed(code, client=client)
    model = first.parsed
    again = approved_model.sync_detailed(code, client=client, if_none_match=first.headers["etag"])
    torque = prediction.sync(model.model_id, client=client, body=WidthsIn(pulse_width_us=[0.0, 150.0, 200.0]))
    plan = widths.sync(model.model_id, client=client, body=ReferenceIn(reference_torque_nm=reference_nm))
    seen = one_participant.sync_detailed(code, client=client).headers["etag"]
    trial = TestIn(participant=code, kind="sequence", segments=plan.segments, pulse_rate_hz=plan.pulse_rate_hz)
    begun = start_test.sync_detailed(client=client, body=trial, if_match=seen)
    assert begun.status_code == 202, begun.content
    while not (now := one_test.sync(begun.parsed.id, client=client)).done:
        time.sleep(0.1)
    record = recording.sync_detailed(now.recording_id, client=client)
    told = tracking.sync(code, client=client)
    missing = one_model.sync(model_id="nothing", client=client)
    stopped = stop.sync_detailed(client=client)
print(json.dumps({
    "sample_rate_hz": model.sample_rate_hz, "again": again.status_code, "torques": len(torque.torque_nm),
    "widths": len(plan.pulse_width_us), "state": now.state, "record": record.content[:4].hex(),
    "trials": len(told.trials), "missing": missing.title, "stopped": stopped.status_code,
}))  # fmt: skip
