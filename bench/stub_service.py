"""The rig's service with a worker that fits nothing: for loads in which fits would take all the time."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path

from stimrig.api.web import server
from stimrig.api.web.app import create_app

STUB = (sys.executable, str(Path(__file__).parents[1] / "tests" / "api" / "stub_worker.py"))

if __name__ == "__main__":
    server.create_app = partial(create_app, worker=STUB)
    sys.exit(server.main())
