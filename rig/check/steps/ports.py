"""The names of the rig file: ports and adapters are there, this user may use them, and nobody else does."""

from __future__ import annotations

from collections.abc import Iterator

from stimrig.rig.check.bench import Bench
from stimrig.rig.check.finding import Fault, Finding, failed, passed

ORDER, TITLE, NEEDED = 15, "ports and adapters", True
LATENCY_MS = 4
FAULTS = {
    "port_missing": Fault(
        "a port of the rig file is not there: the device is off or unplugged, or its udev name is another one",
        "switch it on and plug it in; `ls -l /dev/stimrig /dev/serial/by-id` shows the names: correct the rig file",
    ),
    "port_forbidden": Fault(
        "this user may not read and write the port",
        "install deploy/udev/70-stimrig.rules and plug the device in again, or add the user to the port's group",
    ),
    "port_in_use": Fault(
        "another program has the port open: two rigs on one device",
        "stop the other program (systemctl stop stimrig-rig), and remove the second rig file that names this port",
    ),
    "same_port": Fault(
        "the stimulator and the CAN adapter have the same port in the rig file",
        "give each its own: `ls -l /dev/stimrig` shows which is which",
    ),
    "latency_timer": Fault(
        "the FTDI chip keeps bytes back, so each answer comes late",
        "install deploy/udev/70-stimrig.rules, or echo 1 > /sys/bus/usb-serial/devices/ttyUSB0/latency_timer",
    ),
    "can_missing": Fault(
        "there is no such CAN interface",
        "plug the adapter in; `ip link` shows the names: correct load_cell.bus in the rig file",
    ),
    "can_down": Fault(
        "the CAN interface is down, or off the bus after errors",
        "systemctl restart stimrig-can@can0; if it goes off again, check bit rate and termination",
    ),
}


async def look(bench: Bench) -> Finding:
    for found in await bench.tasks.work(lambda: list(_looked(bench))):
        bench.halted = bench.halted or found.figure
        return found
    return passed(", ".join([*_serial(bench), *_links(bench)]) or "none to look at", "there, free, and may be used")


def _serial(bench: Bench) -> dict[str, str]:
    """The serial ports of the rig file, and what is on them."""
    config, found = bench.given, dict[str, str]()
    for kind, settings in config.devices().items():
        values = settings.model_dump()
        bus = values.get("bus") or {}
        port = values.get("port") or (
            bus.get("channel", "").partition("@")[0] if bus.get("interface") == "slcan" else ""
        )
        if port and kind != "angle_sensor":
            found[kind] = str(port)
    return found


def _links(bench: Bench) -> list[str]:
    bus = bench.cell.get("bus") or {}
    return [str(bus["channel"])] if bus.get("interface") == "socketcan" else []


def _looked(bench: Bench) -> Iterator[Finding]:
    """What is wrong, the worst first."""
    see, ports = bench.surroundings, _serial(bench)
    for kind, port in ports.items():
        if not see.exists(port):
            yield failed("port_missing", f"{kind}: {port} is not there")
    if len({see.real(port) for port in ports.values()}) < len(ports):
        yield failed("same_port", " and ".join(f"{kind}: {port}" for kind, port in ports.items()))
    for kind, port in ports.items():
        if not see.may_use(port):
            yield failed("port_forbidden", f"{kind}: {port} may not be read and written")
        if holder := see.holder(port):
            yield failed("port_in_use", f"{kind}: {port} is open in {holder}")
        latency_ms = see.latency_ms(port)
        if latency_ms is not None and not (latency_ms <= LATENCY_MS):
            yield failed("latency_timer", f"{kind}: {port} keeps bytes for {latency_ms} ms", f"at most {LATENCY_MS} ms")
    for link in _links(bench):
        found = see.can_link(link)
        if found is None:
            yield failed("can_missing", f"{link} is not there")
        elif not found["up"] or found.get("state") == "BUS-OFF":
            yield failed("can_down", f"{link} is {found.get('state') or 'down'}")
