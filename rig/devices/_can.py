"""Base of drivers of CAN sensors: samples are decoded by a DBC file, so a new sensor needs only a description."""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any, ClassVar, cast

import cantools
import numpy as np
from cantools.database import Database
from cantools.database.can import Message
from cantools.database.namedsignalvalue import NamedSignalValue

from stimrig.rig.devices import DeviceSettings
from stimrig.rig.errors import ConfigError, WireError
from stimrig.rig.machine import Bus, Frame, Listener, Machine
from stimrig.rig.signals import Block

CELL_FAULT = "Cell_Fault"
"""A cell's own fault, in the descriptions that have it."""
PACKAGED = "torque_default"
"""The default description: frame 0x181, float32 in N·m, counter, sync bit."""


def load(dbc: str) -> Database:
    """Read a DBC file, or the packaged one of that name. Raises ConfigError: missing, or not a DBC file."""
    try:
        if "/" not in dbc and not dbc.endswith(".dbc"):
            text = resources.files("stimrig.rig.devices").joinpath(f"{dbc}.dbc").read_text("utf-8")
        else:
            text = Path(dbc).read_text("cp1252")
        database = cantools.database.load_string(text, "dbc")
    except OSError:
        raise ConfigError(f"dbc: there is no file {dbc!r}; give the path of a .dbc file or {PACKAGED!r}") from None
    except Exception as error:
        line = " ".join(str(error).split())
        raise ConfigError(f"dbc: {dbc} is not a DBC file that can be read: {line}") from None
    if not isinstance(database, Database):
        raise ConfigError(f"dbc: {dbc} describes no CAN messages")
    return database


def _choose(kind: str, name: str, known: Sequence[str], place: str) -> str:
    if name in known:
        return name
    near = difflib.get_close_matches(name, known, 1)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    raise ConfigError(f"{kind}: {place} has no {kind} {name!r}{hint} (it has: {', '.join(known) or 'none'})")


def _measured(value: float | NamedSignalValue) -> float:
    """Return a signal's value; NaN where the description has a word for it."""
    return math.nan if isinstance(value, NamedSignalValue) else float(value)


def _raw(value: float | NamedSignalValue) -> float:
    """Return a counter's or a status word's value, also where the description has a word for it."""
    return value.value if isinstance(value, NamedSignalValue) else value


@dataclass(frozen=True, slots=True)
class FrameSamples:
    """Content of one frame: values in the signal's unit, counter (−1: none), flag (0; 1: any other; 255: none)."""

    values: tuple[float, ...]
    counter: int
    flag: int


class SampleFrame:
    """Decoder of the message that contains the torque or the angle.

    `dbc`: path of a DBC file or the name of a packaged one. `message`: None: the first one with the signal. `signals`:
    names, in order of time (several if a frame contains several samples). `counter`, `flag`: signals of the counter and
    of a word of which every value but 0 says the same (a cell's sync line, a sensor's fault), None or empty if there is
    none; `flag_key` is how the rig file calls that word. `fault`: signal of a word of which every value but 0 says that
    the frame's values are no numbers; `CELL_FAULT` may be missing.

    Raises ConfigError: the file lacks the message or signal; lists those that it has.
    """

    def __init__(
        self,
        dbc: str,
        message: str | None,
        signals: Sequence[str],
        counter: str | None,
        flag: str | None,
        flag_key: str = "sync",
        fault: str | None = None,
    ) -> None:
        database = load(dbc)
        if message is None:
            having = [m for m in database.messages if signals[0] in m.signal_tree]
            known = [s.name for m in database.messages for s in m.signals]
            if not having:
                _choose("signal", signals[0], known, dbc)
            message_format = having[0]
        else:
            message_format = database.get_message_by_name(
                _choose("message", message, [m.name for m in database.messages], dbc)
            )
        self.message: Message = message_format
        names = [s.name for s in message_format.signals]
        place = f"message {message_format.name} of {dbc}"
        self._signals = tuple(_choose("signal", s, names, place) for s in signals)
        for name in self._signals:
            signal = message_format.get_signal_by_name(name)
            if signal.is_float and signal.choices:  # a word is looked up by a whole number: 5.1 would be a 5
                raise ConfigError(f"signal: {place}, {name}: a floating-point signal has no words; remove its VAL_")
        self._counter = _choose("counter", counter, names, place) if counter else None
        self._flag = _choose(flag_key, flag, names, place) if flag else None
        is_missing = not fault or (fault == CELL_FAULT and fault not in names)
        self._fault = None if is_missing else _choose("fault", str(fault), names, place)
        self.counter_modulus = 0
        if self._counter:
            self.counter_modulus = 1 << message_format.get_signal_by_name(self._counter).length

    @property
    def samples_per_frame(self) -> int:
        return len(self._signals)

    def decode(self, data: bytes) -> FrameSamples:
        """Values of one frame; NaN where the description has a word for a value (`VAL_`, as "no reading"), and in a
        frame that reports a fault.

        Raises WireError: the frame is too short for the description.
        """
        try:
            values = cast(
                "dict[str, float | NamedSignalValue]",
                # a frame may be shorter than described, but the signals needed here must be in it
                self.message.decode(data, decode_choices=True, scaling=True, allow_truncated=True),
            )
            faulty = self._fault is not None and _raw(values[self._fault]) != 0
            return FrameSamples(
                tuple(math.nan if faulty else _measured(values[s]) for s in self._signals),
                int(_raw(values[self._counter])) if self._counter else -1,
                int(_raw(values[self._flag]) != 0) if self._flag else 255,
            )
        except Exception as error:
            raise WireError(f"frame {data.hex(' ')} does not fit {self.message.name}: {error}") from None


class CanSettings(DeviceSettings):
    """Settings of every driver on a CAN bus."""

    bus: dict[str, Any]
    dbc: str
    message: str | None
    counter: str | None
    sample_rate_hz: float


class CanSensor:
    """Base of the drivers of sensors on a CAN bus; see `rig.devices.Sensor` for what the methods promise.

    `frame`: further arguments of the decoder of its frames, after the message.
    """

    name: ClassVar[str]
    """For messages; with `_` it is its table in the rig file."""
    dtype: ClassVar[np.dtype[Any]]

    def __init__(self, settings: CanSettings, machine: Machine, *frame: Any) -> None:
        try:
            self._frame = SampleFrame(settings.dbc, settings.message, *frame)
        except ConfigError as error:
            raise ConfigError(f"{self.name.replace(' ', '_')}.{error}") from None
        self._device, self._machine, self.sample_rate_hz = settings.device, machine, settings.sample_rate_hz
        self.counter_modulus = self._frame.counter_modulus * self._frame.samples_per_frame
        self._bus: Bus | None = None
        self._listener: Listener | None = None

    def decode(self, frames: Sequence[Frame], damaged: int = 0, errors: int = 0) -> Block:
        """The samples of frames, in their order; damaged ones are counted. Pure."""
        rows: list[tuple[float, ...]] = []
        for frame in frames:
            try:
                rows += self._rows(frame, self._frame.decode(frame.data))
            except WireError:
                damaged += 1
        return Block(np.array(rows, dtype=self.dtype), damaged, errors)

    def _rows(self, frame: Frame, samples: FrameSamples) -> Iterable[tuple[float, ...]]:
        """The samples of a frame."""
        raise NotImplementedError

    def _listen(self, bus: Bus, on_block: Callable[[Block], None], on_lost: Callable[[str], None]) -> dict[str, Any]:
        """Take the bus's frames from now on; the identity to display."""
        message = self._frame.message
        self._bus = bus
        self._listener = Listener(message.frame_id, message.is_extended_frame, self.decode, on_block, on_lost)
        bus.listen(self._listener)
        return {
            "device": self._device,
            "bus": bus.place,
            "frame_id": f"0x{message.frame_id:X}",
            "message": message.name,
            "sample_rate_hz": self.sample_rate_hz,
        }
