"""Hasomed RehaMove P24 in ScienceMode 4's low level: one command a pulse, so silence is no stimulation.

Takes only width and current and draws the symmetric biphasic pulse itself: an unbalanced pulse cannot be asked for.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import serial
from pydantic import Field

from rig.clock import Clock
from rig.devices import DeviceSettings
from rig.errors import DeviceError, WireError
from rig.limits import Admitted
from rig.signals import Ack
from rig.wire import sciencemode4 as wire
from rig.wire.sciencemode4 import Command, Packet

KIND = "stimulator"

BAUD_RATE = 3_000_000
READ_TIMEOUT_S = 0.05
WRITE_TIMEOUT_S = 0.05
NOT_INITIALISED = 7


class Settings(DeviceSettings):
    port: str = Field(description="serial port, e.g. /dev/serial/by-id/usb-HASOMED_P24-if00")
    channel: int = Field(1, ge=1, le=4, description="1 red, 2 blue, 3 black, 4 white")
    connector: int = Field(1, ge=1, le=2, description="1 yellow, 2 green")
    reply_timeout_s: float = Field(0.5, gt=0, le=5, description="for commands other than pulses, real seconds")


class P24:
    """Driver of one P24 on one serial port; see `rig.devices.Stimulator` for what the methods promise."""

    def __init__(self, settings: Settings, clock: Clock) -> None:
        self._settings = settings
        self._clock = clock
        self._serial: serial.Serial | None = None
        self._write_lock = threading.Lock()
        self._number = 0
        self._reader: threading.Thread | None = None
        self._closing = threading.Event()
        self._answered = threading.Condition()
        self._waiting: dict[int, Packet | None] = {}
        self._lost = ""
        self._on_ack: Callable[[Ack], None] = lambda _: None
        self._on_lost: Callable[[str], None] = lambda _: None

    def listen(self, on_ack: Callable[[Ack], None], on_lost: Callable[[str], None]) -> None:
        self._on_ack, self._on_lost = on_ack, on_lost

    def open(self) -> dict[str, Any]:
        port = self._settings.port
        if not Path(port).exists():
            raise DeviceError(f"stimulator.port: {port} is not there; plug the stimulator in or correct the port")
        try:
            self._serial = serial.Serial(
                port,
                BAUD_RATE,
                stopbits=serial.STOPBITS_TWO,
                rtscts=True,
                timeout=READ_TIMEOUT_S,
                write_timeout=WRITE_TIMEOUT_S,
                exclusive=True,
            )
        except (serial.SerialException, OSError, ValueError) as error:
            raise DeviceError(
                f"stimulator.port: {port} cannot be opened ({error}); is another program using it?"
            ) from None
        self._closing.clear()
        self._lost = ""
        self._reader = threading.Thread(target=self._read, name="stimulator-acks", daemon=True)
        self._reader.start()
        try:
            serial_number = wire.parse_device_id(self._ask(Command.DEVICE_ID).data)
            firmware = wire.parse_version(self._ask(Command.EXTENDED_VERSION).data)
            _, state = self.state()
        except DeviceError:
            self.close()
            raise
        return {
            "device": "p24",
            "id": serial_number,
            "firmware": firmware,
            "port": port,
            "channel": self._settings.channel,
            "state": state,
        }

    def arm(self) -> None:
        self._ask(Command.LL_INIT)

    def send(self, pulse: Admitted) -> int:
        channel, connector = self._settings.channel - 1, self._settings.connector - 1
        with self._write_lock:
            number = self._next_number()
            try:
                frame = wire.ll_pulse(number, channel, pulse.pulse_width_us, pulse.current_ma, connector)
            except WireError as error:
                raise DeviceError(f"pulse cannot be sent: {error}") from None
            self._write(frame)
        return number

    def stop(self) -> None:
        self._ask(Command.LL_STOP, fine=(0, NOT_INITIALISED))  # one that is not initialised has stopped already

    def state(self) -> tuple[bool, str]:
        result, level, _ = wire.parse_status(self._ask(Command.STIM_STATUS).data)
        if result != 0:
            raise DeviceError(f"stimulator {self._settings.port} answered its state with {wire.result_text(result)}")
        return level == 0, wire.LEVELS.get(level, f"level {level}")

    def close(self) -> None:
        self._closing.set()
        if self._reader is not None and self._reader is not threading.current_thread():
            self._reader.join(timeout=1.0)
        if self._serial is not None:
            with contextlib.suppress(OSError):  # an unplugged line cannot be given back
                self._serial.close()
            self._serial = None

    def _next_number(self) -> int:
        self._number = (self._number + 1) % wire.NUMBERS
        return self._number

    def _write(self, frame: bytes) -> None:
        if self._serial is None or self._lost:
            raise DeviceError(f"stimulator {self._settings.port} is not connected: {self._lost or 'not opened'}")
        try:
            self._serial.write(frame)
        except (serial.SerialException, OSError) as error:
            raise DeviceError(f"stimulator {self._settings.port} took no bytes: {error}") from None

    def _ask(self, command: Command, fine: tuple[int, ...] = (0,)) -> Packet:
        """Send a command and wait for its ack.

        Raises
        ------
        DeviceError
            No ack in time, or an ack with an error.
        """
        with self._write_lock:
            number = self._next_number()
            with self._answered:
                self._waiting[number] = None
            try:
                data = bytes((0,)) if command == Command.LL_INIT else b""
                self._write(wire.encode(Packet(number, command, data)))
            except DeviceError:
                with self._answered:
                    self._waiting.pop(number, None)
                raise
        with self._answered:
            self._answered.wait_for(
                lambda: self._waiting[number] is not None or bool(self._lost), self._settings.reply_timeout_s
            )
            packet = self._waiting.pop(number)
        name = command.name.lower().replace("_", " ")
        if packet is None:
            why = self._lost or f"no answer in {self._settings.reply_timeout_s:g} s"
            raise DeviceError(f"stimulator {self._settings.port}: {name}: {why}; is it switched on?")
        if packet.command != command + 1:
            raise DeviceError(f"stimulator {self._settings.port}: {name}: answered with command {packet.command}")
        if packet.data and packet.data[0] not in fine:
            raise DeviceError(f"stimulator {self._settings.port}: {name}: {wire.result_text(packet.data[0])}")
        return packet

    def _read(self) -> None:
        frames = wire.FrameReader()
        port = self._serial
        assert port is not None
        while not self._closing.is_set():
            try:
                data = port.read(1)
                if data:
                    data += port.read(port.in_waiting)
            except (serial.SerialException, OSError, TypeError) as error:
                # TypeError: pyserial's answer to a port closed under a read
                if not self._closing.is_set():
                    self._lose(f"the line broke ({error})")
                return
            time_s = self._clock.now_s()
            for packet in frames.feed(data):
                self._take(packet, time_s)

    def _lose(self, reason: str) -> None:
        with self._answered:
            self._lost = reason
            self._answered.notify_all()
        self._on_lost(f"stimulator {self._settings.port}: {reason}")

    def _take(self, packet: Packet, time_s: float) -> None:
        if packet.command == Command.LL_CHANNEL_CONFIG + 1:
            result = packet.data[0] if packet.data else 1
            self._on_ack(Ack(packet.number, time_s, wire.result_text(result) if result else None))
            return
        if packet.command in (Command.GENERAL_ERROR, Command.UNKNOWN_COMMAND):
            result = packet.data[0] if packet.data else 0
            words = wire.result_text(result) if result else "unknown command"
            self._on_ack(Ack(packet.number, time_s, words))
        with self._answered:
            if packet.number in self._waiting:
                self._waiting[packet.number] = packet
                self._answered.notify_all()


def create(settings: Settings, clock: Clock) -> P24:
    """The device, not yet opened."""
    return P24(settings, clock)
