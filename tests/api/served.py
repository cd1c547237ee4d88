"""`api.server` as a process, with the stub worker in identify's place: starts quickly, to be killed and begun anew."""

from __future__ import annotations

import sys
from functools import partial

from api import server
from tests.api.conftest import STUB

if __name__ == "__main__":
    server.create_app = partial(server.create_app, worker=STUB)
    sys.exit(server.main())
