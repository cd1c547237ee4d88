"""Work of the preview builder, in its own process (see `stimrig.rig.builder`)."""

from __future__ import annotations

import json
import time
from typing import BinaryIO

from pydantic import ValidationError

from stimrig.rig import limits, plan
from stimrig.rig.control.calibration import check_profile, check_range
from stimrig.rig.control.replies import id_of, internal_error, invalid_request, refusal, to_line
from stimrig.rig.errors import RigError
from stimrig.rig.limits import Limit
from stimrig.rig.messages import Preview, PreviewRequest, Reply


def previewed(
    request: PreviewRequest,
    table: dict[str, Limit],
    unix_s: float,
    speed: float = 1.0,
    angle_set_at_utc: str | None = None,
) -> Preview:
    """Duration, dose and pulses of a plan. Raises PlanError, RefusedError."""
    check_range(request.plan, angle_set_at_utc)
    test = plan.build(request.plan, limits.for_plan(table, request.plan))
    check_profile(request.plan.profile, unix_s, required=False, duration_s=test.longest_s / speed)
    return plan.preview(test, request.recruitment)


def answer(line: bytes, table: dict[str, Limit], unix_s: float, speed: float, angle_set_at_utc: str | None) -> Reply:
    """The reply to one request."""
    try:
        request = PreviewRequest.model_validate_json(line)
        body = previewed(request, table, unix_s, speed, angle_set_at_utc).model_dump(mode="json")
        return Reply(id=request.id, ok=True, body=body)
    except ValidationError as error:
        return invalid_request(id_of(line), error)
    except RigError as error:
        return refusal(id_of(line), error)
    except Exception as error:
        return internal_error(id_of(line), error)


def serve(requests: BinaryIO, replies: BinaryIO) -> None:
    """Read the rig's limits from the first line, then answer requests until the end of input.

    Before each request stands a line with the angle sensor's `set_at_utc`, which changes while the rig runs.
    """
    first = requests.readline()
    if not first:
        return
    settings = json.loads(first)
    table = {name: Limit(**row) for name, row in settings["table"].items()}
    for of_angle in requests:
        reply = answer(requests.readline(), table, time.time(), settings["speed"], json.loads(of_angle))
        replies.write(to_line(reply))
        replies.flush()
