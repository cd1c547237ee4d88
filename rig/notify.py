"""Messages to systemd: ready, alive, stopping (the sd_notify protocol, one datagram for each message).

Without systemd (no NOTIFY_SOCKET) nothing is sent. Source: systemd, sd_notify(3).
"""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Mapping


class Notifier:
    """Sends messages to the service manager that started this process; never blocks, never raises."""

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        address = environment.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address  # @: an abstract socket
        meant = environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())  # else it was a parent's
        self.watched = bool(address) and meant and environment.get("WATCHDOG_USEC", "").isdigit()
        self._complained = False

    def ready(self) -> None:
        """The socket answers and both devices have been tried."""
        self._tell("READY=1")

    def alive(self, trouble: str | None) -> None:
        """Feed the watchdog if all is well; else report what is wrong, and let the watchdog expire.

        Parameters
        ----------
        trouble
            What `Rig.trouble` found; None: nothing.
        """
        if trouble is None:
            if self._complained:
                self._tell("STATUS=")
            self._complained = False
            if self.watched:
                self._tell("WATCHDOG=1")
        elif not self._complained:
            self._complained = True
            self._tell(f"STATUS=not fed: {trouble}")

    def stopping(self) -> None:
        """The rig stops stimulation and seals the recording."""
        self._tell("STOPPING=1")

    def _tell(self, words: str) -> None:
        if not self._address:
            return
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as line:
            line.setblocking(False)
            line.sendto(words.encode(), self._address)
