"""What only a person can do or see, as questions, and who answers them: a terminal, options, the emulator's hands."""

from __future__ import annotations

import json
import socket
import sys
from collections.abc import Callable, Mapping
from typing import Any, Protocol

QUESTIONS = {
    "by": "Who does this check?",
    "load": "Nobody may be connected to the stimulator. Put a resistor of {ohm:g} Ω (2 W) on each pair of cables. Then "
    "type the output on which the load is, as the stimulator's case names it ({example})",
    "weight_on": "Take everything off the lever; then hang a weight on it that makes {weight_nm:g} N·m in the "
    "direction of flexion. Type yes when it hangs still",
    "weight_off": "Take the weight off. Type yes when it is off",
    "bend": "Bend the joint (or the sensor's lever) by 30° or more in the direction of flexion. Type yes when it is",
    "unplug": "Take the load off the channel {name} alone. Type yes when it is off",
    "plug": "Put the load back on the channel {name}. Type yes when it is on",
    "scope": "Have you an oscilloscope over the load? Pulses flow for 2 s after your answer. Type yes, or nothing",
    "scope_width_us": "How wide was the first phase of the last pulse, µs?",
    "scope_voltage_v": "How high was it, V?",
    "scope_silent": "Did the stimulator or the oscilloscope show pulses while the computer stood still? yes or no",
    "emergency": "Next the stimulator's own emergency stop: press it as soon as pulses flow (15 s). Type yes to begin",
    "release": "Release the emergency stop. Type yes when it is released",
    "serial_stimulator": "Serial number of the stimulator (on its case)?",
    "serial_load_cell": "Serial number of the load cell (on its case)?",
}
"""By the names under which a script answers them (`--answer NAME=TEXT`)."""


class Person(Protocol):
    """Whoever stands at the rig. Its methods may block: they are called as work of another thread."""

    def ask(self, question: str, /, **words: Any) -> str | None:
        """The answer to one of `QUESTIONS`; None: nobody answers, so that what needs it is not done."""
        ...

    def tell(self, what: str) -> None:
        """Pulses flow, or the computer is about to stand still: `emergency` or `silence`."""
        ...


class Scripted:
    """Answers of options; whom to ask for the others.

    `answers`: by names of `QUESTIONS`, or by `QUESTION:CHANNEL`.
    """

    def __init__(self, answers: Mapping[str, str], other: Person | None = None) -> None:
        self._answers, self._other = answers, other

    def ask(self, question: str, /, **words: Any) -> str | None:
        for key in (f"{question}:{words.get('name', '')}", question):
            if key in self._answers:
                return self._answers[key] or None
        return self._other.ask(question, **words) if self._other else None

    def tell(self, what: str) -> None:
        if self._other:
            self._other.tell(what)


class AtTerminal:
    """Asks on standard error, reads standard input."""

    def ask(self, question: str, /, **words: Any) -> str | None:
        print(f"? {QUESTIONS[question].format(**words)}: ", end="", file=sys.stderr, flush=True)
        return sys.stdin.readline().strip() or None

    def tell(self, what: str) -> None:
        if what == "emergency":
            print("! pulses flow: press the stimulator's emergency stop now", file=sys.stderr, flush=True)


class Hands:
    """Does on the emulator what a person does on a rig: hangs the weight, unplugs a load, reads the oscilloscope.

    `control`: answers a request of the emulator's control line; `outputs`: on which the loads truly are (connector and
    channel from 0), by channel.
    """

    def __init__(self, control: Callable[..., dict[str, Any]], outputs: Mapping[str, tuple[int, int]]) -> None:
        self._control, self._outputs = control, outputs
        self._seen = 0

    def ask(self, question: str, /, **words: Any) -> str | None:
        do = getattr(self, f"_{question}", None)
        return "yes" if do is None else do(**words)

    def tell(self, what: str) -> None:
        if what == "emergency":
            self._fault("emergency_switch")
        self._seen = len(self._pulses())

    def _by(self) -> str:
        return "the emulator"

    def _load(self, several: bool, **_words: Any) -> str:
        place = (lambda c, n: f"{c + 1}.{n + 1}") if several else (lambda c, n: str(4 * c + n + 1))
        return ",".join(place(*output) for output in self._outputs.values())

    def _weight_on(self, weight_nm: float, **_words: Any) -> str:
        return self._fault("hung_weight", torque_nm=weight_nm)

    def _weight_off(self, **_words: Any) -> str:
        return self._fault("hung_weight", on=False)

    def _bend(self) -> str:
        self._control(cmd="arm", mode="held", angle_deg=110.0)
        return "yes"

    def _unplug(self, name: str) -> str:
        connector, channel = self._outputs[name]
        return self._fault("electrode_error", output=4 * connector + channel + 1)

    def _plug(self, name: str) -> str:  # noqa: ARG002
        return self._fault("electrode_error", on=False)

    def _scope_width_us(self) -> str | None:
        pulses = self._pulses()
        return f"{pulses[-1]['width_us']:g}" if pulses else None

    def _scope_voltage_v(self, ohm: float) -> str | None:
        pulses = self._pulses()
        return f"{pulses[-1]['current_ma'] * ohm / 1000:g}" if pulses else None

    def _scope_silent(self) -> str:
        return "yes" if len(self._pulses()) - self._seen > 3 else "no"

    def _release(self) -> str:
        return self._fault("emergency_switch", on=False)

    def _serial_stimulator(self) -> str:
        return "emulated"

    _serial_load_cell = _serial_stimulator

    def _fault(self, name: str, on: bool = True, **settings: Any) -> str:
        self._control(cmd="fault", name=name, on=on, **settings)
        return "yes"

    def _pulses(self) -> list[dict[str, Any]]:
        return self._control(cmd="pulses")["pulses"]


def control_line(path: str) -> Callable[..., dict[str, Any]]:
    """The emulator's control line, each request with a connection of its own."""

    def ask(**request: Any) -> dict[str, Any]:
        with socket.socket(socket.AF_UNIX) as line:
            line.connect(path)
            line.sendall(json.dumps(request).encode() + b"\n")
            return json.loads(line.makefile().readline())

    return ask
