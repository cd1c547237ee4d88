"""`python -m stimrig.api.outbox`: tells the centre what the rig has sealed, until SIGTERM.

Exit 2: no centre is configured, a setting does not hold, or the database does not open. Exit 1: it is not there yet.
Exit 0: it was replaced; to be started again.
"""

from __future__ import annotations

import contextlib
import os
import sys

from stimrig.api import logs
from stimrig.api.clock import Clock
from stimrig.api.errors import ApiError, SettingsError
from stimrig.api.outbox.feed import Feed
from stimrig.api.outbox.link import Link
from stimrig.api.outbox.pusher import Pusher
from stimrig.api.settings import Settings
from stimrig.api.store import Store

NICENESS = 10
"""It gives way to the rig, the service and its workers."""


def main() -> int:
    logs.configure("outbox")
    os.umask(os.umask(0o077) | 0o077)
    os.nice(NICENESS)
    clock = Clock()
    try:
        settings = Settings()
        if settings.centre_url is None or settings.centre_key is None:
            raise SettingsError(
                "STIMRIG_CENTRE_URL: names no centre; set it and STIMRIG_CENTRE_KEY, or start no outbox"
            )
        place = settings.data_dir / "stimrig.db"
        if settings.database_url is None and not place.exists():  # the service makes it, and a restore puts it there
            raise FileNotFoundError(f"{place}: no database there yet; start the service first")
        store = Store(settings.database)
    except FileNotFoundError as error:  # it is looked again: whoever started this starts it again
        print(f"outbox: {error}", file=sys.stderr)
        return 1
    except (ApiError, SettingsError, OSError) as error:
        print(f"outbox: {error}", file=sys.stderr)
        return 2
    Feed(store, clock)  # what it writes itself is told, too
    link = Link(settings.centre_url, settings.centre_key.get_secret_value(), clock)
    with contextlib.suppress(KeyboardInterrupt):
        Pusher(store, settings, clock, link).run()
    return 0


if __name__ == "__main__":
    sys.exit(main())
