"""`api.web.server` as a process, with a stub worker instead of identify: it starts quickly and can be killed."""

from __future__ import annotations

import sys
from functools import partial

from stimrig.api.jobs.worker import Worker
from stimrig.api.web import server

if __name__ == "__main__":
    server.create_app = partial(server.create_app, worker=partial(Worker, "tests.api.stub_worker"))
    sys.exit(server.main())
