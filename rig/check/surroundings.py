"""What the system says of ports and adapters, without opening any of them."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
from pathlib import Path
from typing import Any

SYSFS = Path("/sys/class/tty")
NET = Path("/sys/class/net")
CAN_TYPE = "280"
"""Of a network interface that is CAN (`ARPHRD_CAN`)."""


class Surroundings:
    """Of this machine."""

    def real(self, path: str) -> str:
        """The device behind a name by udev."""
        return os.path.realpath(path)

    def exists(self, path: str) -> bool:
        return Path(path).exists()

    def may_use(self, path: str) -> bool:
        """Whether this user may read and write it."""
        return os.access(path, os.R_OK | os.W_OK)

    def usb_id(self, path: str) -> str:
        """Vendor and product in hex, `0483:5740`; empty: none is known."""
        folder = (SYSFS / Path(self.real(path)).name / "device").resolve()
        for place in (folder, *folder.parents[:3]):
            with contextlib.suppress(OSError):
                return ":".join((place / name).read_text().strip() for name in ("idVendor", "idProduct"))
        return ""

    def latency_ms(self, path: str) -> int | None:
        """For how long an FTDI chip keeps bytes back; None: it is no such chip."""
        with contextlib.suppress(OSError, ValueError):
            return int((SYSFS / Path(self.real(path)).name / "device" / "latency_timer").read_text())
        return None

    def holder(self, path: str) -> str:
        """Another process that has it open, in words; empty: none that this user may see.

        Of a pseudo-terminal the emulator holds both ends, so there it says nothing.
        """
        real = self.real(path)
        if real.startswith("/dev/pts/"):
            return ""
        for place in Path("/proc").glob("[0-9]*/fd/*"):
            with contextlib.suppress(OSError):
                pid = place.parts[2]
                if pid != str(os.getpid()) and str(place.readlink()) == real:
                    return f"process {pid} ({(place.parents[1] / 'comm').read_text().strip()})"
        return ""

    def can_link(self, channel: str) -> dict[str, Any] | None:
        """`up`, `bitrate` and `state` of a CAN interface, as far as the system tells them; None: there is none."""
        place = NET / channel
        if not place.exists():
            return None
        found: dict[str, Any] = {"up": bool(int((place / "flags").read_text(), 16) & 1)}
        with contextlib.suppress(OSError, ValueError, KeyError, IndexError):
            command = ["ip", "-json", "-details", "link", "show", channel]
            said = json.loads(subprocess.run(command, capture_output=True, text=True, timeout=5).stdout)
            data = said[0]["linkinfo"]["info_data"]
            found |= {"state": data.get("state", ""), "bitrate": data.get("bittiming", {}).get("bitrate")}
        return found

    def can_links(self) -> list[str]:
        """Names of the CAN interfaces."""
        found = [place for place in NET.glob("*") if (place / "type").is_file()]
        return sorted(place.name for place in found if (place / "type").read_text().strip() == CAN_TYPE)
