"""What a new rig file needs to know: one question for each key, its default, and the comment in the file."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

from stimrig.rig import devices
from stimrig.rig.errors import ConfigError
from stimrig.rig.limits import HARD_LIMITS
from stimrig.rig.setup.ports import Found, proposed


class Question(NamedTuple):
    """`option`: of the command line, and the name by which the file's text takes it. `default`: of what was answered
    before it. `number`: the answer must be one."""

    option: str
    words: str
    default: Callable[[Mapping[str, str]], str]
    number: bool = False


LIMITS = {
    "pulse_width_us": "400",
    "current_ma": "60",
    "torque_nm": "40",
    "rest_between_tests_s": "60",
}
"""Limits that are asked for, and what is proposed; each tighter than its hard limit."""


def questions(ports: list[Found], links: list[str]) -> list[Question]:
    """In the order in which they are asked."""
    likely = "rehastim2" if not proposed(ports, "p24") and proposed(ports, "rehastim2") else "p24"

    def stimulator_port(answers: Mapping[str, str]) -> str:
        return proposed(ports, answers["stimulator"]) or "/dev/stimrig/stimulator"

    def can(_: Mapping[str, str]) -> str:
        return links[0] if links else proposed(ports, "slcan") or "can0"

    return [
        Question("stimulator", f"Stimulator ({', '.join(devices.library('stimulator'))})", lambda _: likely),
        Question("port", "Serial port of the stimulator", stimulator_port),
        Question(
            "channels",
            "Output of the stimulator (P24: CONNECTOR.CHANNEL, RehaStim 2: CHANNEL); several: NAME=OUTPUT,NAME=OUTPUT",
            lambda answers: "1.1" if answers["stimulator"] == "p24" else "1",
        ),
        Question("can", "CAN interface of the load cell, or the serial port of an slcan adapter", can),
        Question("dbc", "DBC file of the cell, or a packaged description", lambda _: "torque_default"),
        Question("signal", "Signal of the torque in it", lambda _: "Torque_Nm"),
        Question(
            "scale-nm", "N·m for one unit of that signal (a force cell in N: the lever arm in m)", _always("1.0"), True
        ),
        Question("counter", 'Signal of the counter of samples ("-": it has none)', _always("Counter")),
        Question("sync", 'Signal of the stimulator\'s sync line ("-": it is not wired)', _always("Sync")),
        Question("sample-rate-hz", "Samples per second of the cell", _always("1600"), True),
        Question("data-dir", "Folder for journals and recordings", _always("/var/lib/stimrig/rig")),
        Question("socket", "Socket on which the service reaches the rig", _always("/run/stimrig/rig.sock")),
        *[
            Question(_option(name), f"Limit {name} ({_hard(name)})", _always(value), True)
            for name, value in LIMITS.items()
        ],
    ]


def _always(value: str) -> Callable[[Mapping[str, str]], str]:
    return lambda _: value


def _option(name: str) -> str:
    return "limit-" + name.replace("_", "-")


def _hard(name: str) -> str:
    row = HARD_LIMITS[name]
    return (
        f"hard limit: at least {row.lo:g} {row.unit}"
        if name.startswith("rest")
        else f"hard limit {row.hi:g} {row.unit}"
    )


def channels_of(text: str, stimulator: str) -> list[tuple[str, dict[str, int]]]:
    """Each channel's name and its output as keys of the rig file. Raises ConfigError."""
    found = []
    for part in text.split(","):
        name, equals, place = part.strip().rpartition("=")
        numbers = place.split(".")
        keys = ["connector", "channel"] if stimulator == "p24" and len(numbers) == 2 else ["channel"]
        if (
            len(numbers) != len(keys)
            or not all(number.isdecimal() for number in numbers)
            or ("," in text and not equals)
        ):
            raise ConfigError(f"--channels {text}: write 1.1 or 1, or for several biceps=1.1,triceps=1.2")
        found.append((name, dict(zip(keys, map(int, numbers), strict=True))))
    return found
