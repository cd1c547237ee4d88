"""Base of drivers of stimulators on a serial line: frames of ScienceMode 2 and 4, and commands with their acks."""

from __future__ import annotations

import binascii
import logging
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, ClassVar, Generic, TypeVar

from stimrig.rig.devices import DeviceSettings
from stimrig.rig.errors import DeviceError, WireError
from stimrig.rig.machine import Machine
from stimrig.rig.signals import Ack, LateError
from stimrig.rig.tasks import Signal

START, STOP, ESCAPE, KEY = 0xF0, 0x0F, 0x81, 0x55
SHORTEST_BODY_BYTES = 2

_STUFFED = {byte: bytes((ESCAPE, byte ^ KEY)) for byte in (START, STOP, ESCAPE)}


@dataclass(frozen=True, slots=True)
class Packet:
    """Content of one frame: packet number, command, data."""

    number: int
    command: int
    data: bytes = b""


def stuff(payload: bytes) -> bytes:
    """Payload with `F0`, `0F` and `81` each replaced by an escape and the byte xor 55."""
    return b"".join(_STUFFED.get(byte) or bytes((byte,)) for byte in payload)


def unstuff(stuffed: bytes) -> bytes:
    """The inverse of `stuff`.

    Raises WireError: the last byte is an escape, or there is a start or stop byte: a wrong length took it from the next
    frame.
    """
    if START in stuffed or STOP in stuffed:
        raise WireError("a start or stop byte within the payload")
    out = bytearray()
    rest = iter(stuffed)
    for byte in rest:
        if byte == ESCAPE:
            escaped = next(rest, None)
            if escaped is None:
                raise WireError("payload ends within an escape")
            byte = escaped ^ KEY
        out.append(byte)
    return bytes(out)


@dataclass(frozen=True, slots=True)
class Framing:
    """Differences between the protocols, which share start byte, header, stuffed body and stop byte.

    Each header byte stands behind an escape, xor 55. A frame's end is found by its length, since a header byte may
    itself look like `F0` or `0F`. After damage the reader continues at the next `F0 81`.
    """

    header_fields: int  # number of header bytes, without their escapes
    header: Callable[[bytes], bytes]
    """Stuffed body -> header: length and CRC. Raises WireError if the body is too long."""
    frame_length: Callable[[bytes], int]  # header -> length of the whole frame, bytes
    max_frame_bytes: int  # longest frame that a reader waits for
    command_bits: int  # of the payload's first two bytes, which are packet number and command; data follow

    @property
    def numbers(self) -> int:
        """Packet numbers before they repeat."""
        return 1 << 16 - self.command_bits

    @property
    def header_bytes(self) -> int:
        """Start byte and header with its escapes."""
        return 1 + 2 * self.header_fields

    @property
    def min_frame_bytes(self) -> int:
        return self.header_bytes + SHORTEST_BODY_BYTES + 1

    def encode(self, packet: Packet) -> bytes:
        """The frame of a packet, as written to the line."""
        body = stuff(struct.pack(">H", packet.number << self.command_bits | packet.command) + packet.data)
        escaped = b"".join(bytes((ESCAPE, byte ^ KEY)) for byte in self.header(body))
        return bytes((START,)) + escaped + body + bytes((STOP,))

    def decode(self, frame: bytes) -> Packet:
        """The packet of one complete frame.

        Raises WireError: start, escapes, length, CRC or stop byte wrong, or no room for a command.
        """
        if len(frame) < self.min_frame_bytes or frame[0] != START or frame[-1] != STOP:
            raise WireError(f"not a frame: {frame.hex(' ')}")
        header, body = self.header_of(frame), frame[self.header_bytes : -1]
        if self.frame_length(header) != len(frame) or header != self.header(body):
            raise WireError(f"length or CRC wrong: {frame.hex(' ')}")
        payload = unstuff(body)
        if len(payload) < SHORTEST_BODY_BYTES:
            raise WireError(f"no command in frame: {frame.hex(' ')}")
        head = int.from_bytes(payload[:2], "big")
        return Packet(head >> self.command_bits, head & (1 << self.command_bits) - 1, payload[2:])

    def header_of(self, frame: bytes | bytearray) -> bytes:
        """Header of a frame, or of its beginning. Raises WireError if an escape is missing."""
        head = bytes(frame[1 : self.header_bytes])
        if any(byte != ESCAPE for byte in head[::2]):
            raise WireError(f"escapes missing in header: {head.hex(' ')}")
        return bytes(byte ^ KEY for byte in head[1::2])


class FrameReader:
    """Splits a stream of bytes into packets; damaged bytes are skipped and counted in `damaged`."""

    def __init__(self, framing: Framing) -> None:
        self._framing = framing
        self._buffer = bytearray()
        self.damaged = 0

    def feed(self, data: bytes) -> Iterator[Packet]:
        """Take bytes from the line; yields each complete packet."""
        framing = self._framing
        self._buffer += data
        while self._to_start() and len(self._buffer) >= framing.header_bytes:
            try:
                length = framing.frame_length(framing.header_of(self._buffer))
                if not (framing.min_frame_bytes <= length <= framing.max_frame_bytes):
                    raise WireError(f"frame length {length}")
                if len(self._buffer) < length:
                    return
                packet = framing.decode(bytes(self._buffer[:length]))
            except WireError:
                self.damaged += 1
                del self._buffer[:1]
                continue
            del self._buffer[:length]
            yield packet

    def _to_start(self) -> bool:
        """Drop everything before the next `F0 81`; True if the buffer now starts with (a part of) it."""
        start = self._buffer.find(bytes((START, ESCAPE)))
        if start < 0:
            start = len(self._buffer) - self._buffer.endswith(bytes((START,)))
        if start:
            self.damaged += 1
            del self._buffer[:start]
        return bool(self._buffer)


def crc8(data: bytes) -> int:
    """CRC-8, polynomial 07, from 0, not reflected."""
    crc = 0
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ 0x07 if crc & 0x80 else crc << 1) & 0xFF
    return crc


def _header_2(body: bytes) -> bytes:
    if len(body) > 0xFF:
        raise WireError(f"body of {len(body)} bytes, at most {0xFF}")
    return bytes((crc8(body), len(body)))


SCIENCEMODE_2 = Framing(
    header_fields=2,
    header=_header_2,
    frame_length=lambda header: header[1] + 6,
    max_frame_bytes=0xFF + 6,
    command_bits=8,
)
"""The header is a CRC-8 and the length of the stuffed body, a byte each."""
SCIENCEMODE_4 = Framing(
    header_fields=4,
    header=lambda body: struct.pack(">HH", len(body) + 10, binascii.crc_hqx(body, 0)),
    frame_length=lambda header: int.from_bytes(header[:2], "big"),
    max_frame_bytes=128,
    command_bits=10,
)
"""The header is the frame's length and a CRC of the stuffed body, two bytes each.

The longest frame is longer than any answer of the low level. Part of a damaged frame may look like the start of a
longer one, and the reader would then wait for that length and lose the frames in between.
"""

log = logging.getLogger("rig.line")


class LineSettings(DeviceSettings):
    """Settings of every driver on a serial line."""

    port: str
    channel: int
    reply_timeout_s: float


S = TypeVar("S", bound=LineSettings)


class LineStimulator(Generic[S]):
    """Base of the drivers, each with one port; see `rig.devices.Stimulator` for what the methods promise."""

    framing: ClassVar[Framing]
    serial: ClassVar[dict[str, Any]]
    """Arguments of `serial.Serial`."""

    def __init__(self, settings: S, machine: Machine) -> None:
        self._settings, self._name = settings, f"stimulator {settings.port}"
        self._tasks, self._clock = machine.tasks, machine.tasks.clock
        self._port = machine.port(settings.port, **self.serial)
        self._frames, self._number = FrameReader(self.framing), 0
        self._waiting: dict[int, tuple[Signal, list[Packet]]] = {}
        self._lost = "not opened"
        """Why nothing can be written; empty: it can."""
        self._last_written_s = -1e9
        self._on_ack: Callable[[Ack], None] = lambda _: None
        self._on_lost: Callable[[str], None] = lambda _: None

    def listen(self, on_ack: Callable[[Ack], None], on_lost: Callable[[str], None]) -> None:
        self._on_ack, self._on_lost = on_ack, on_lost

    async def open(self) -> dict[str, Any]:
        self._frames = FrameReader(self.framing)
        await self._tasks.work(self._port.open, self._read, self._lose)
        self._lost = ""
        try:
            serial_number, firmware = await self._identity()
            _, state = await self.state()
        except DeviceError:
            self.close()
            raise
        settings = self._settings
        return {
            "device": settings.device,
            "id": serial_number,
            "firmware": firmware,
            "port": settings.port,
            "channel": settings.channel,
            "state": state,
        }

    async def state(self) -> tuple[bool, str]:
        raise NotImplementedError

    def close(self) -> None:
        self._end("not opened")
        self._port.close()

    async def _identity(self) -> tuple[str, str]:
        """Serial number and firmware."""
        raise NotImplementedError

    def _handle(self, packet: Packet, time_s: float) -> None:
        """Take a packet that was read at a time, rig clock: the acks of pulses are told from here."""
        raise NotImplementedError

    def _frame(self, command: IntEnum, data: bytes = b"") -> Callable[[int], bytes]:
        return lambda number: self.framing.encode(Packet(number, command, data))

    def _send(self, make: Callable[[int], bytes], latest_s: float | None = None) -> int:
        """Write the frame that `make` returns for the next packet number; returns the number.

        Raises LateError: the clock had passed `latest_s` right before the write: nothing was written. DeviceError: the
        line accepts no bytes, or the frame cannot be encoded.
        """
        self._number = (self._number + 1) % self.framing.numbers
        try:
            frame = make(self._number)
        except WireError as error:
            raise DeviceError(f"{self._name}: the command cannot be encoded: {error}") from None
        if self._lost:
            raise DeviceError(f"{self._name} is not connected: {self._lost}")
        if latest_s is not None and not (self._clock.now_s() <= latest_s):
            raise LateError
        try:
            written = self._port.write(frame)
        except OSError as error:
            raise DeviceError(f"{self._name} accepted no bytes: {error}") from None
        if written != len(frame):
            raise DeviceError(f"{self._name} accepted {written} of {len(frame)} bytes; check its power")
        self._last_written_s = self._clock.now_s()
        return self._number

    async def _request(self, command: IntEnum, data: bytes = b"") -> Packet:
        """Write a command and wait for its ack, which has its number, and the command + 1.

        Raises DeviceError: no ack in time, or an unexpected answer.
        """
        answered, packets, timeout_s = Signal(), list[Packet](), self._settings.reply_timeout_s
        number, waited_s = self._send(self._frame(command, data)), 0.0
        self._waiting[number] = answered, packets
        while waited_s < timeout_s and not answered.is_set():
            waited_s += await self._tasks.look_again(answered)
        if self._waiting.get(number, (None,))[0] is answered:
            del self._waiting[number]
        if not packets:
            why = self._lost or f"no answer in {timeout_s:g} s"
            raise DeviceError(f"{self._name}: {in_words(command)}: {why}; check its power")
        if packets[0].command != command + 1:
            raise DeviceError(f"{self._name}: {in_words(command)}: answered with command {packets[0].command}")
        return packets[0]

    def _read(self, data: bytes, time_s: float) -> None:
        try:
            for packet in self._frames.feed(data):
                self._handle(packet, time_s)
                if packet.number in self._waiting:
                    answered, packets = self._waiting.pop(packet.number)
                    packets.append(packet)
                    answered.set()
        except Exception as error:  # a bug in a driver: report it at once, not after a timeout
            log.exception("the reader of %s failed", self._settings.port)
            self._lose(f"internal: {type(error).__name__}: {error}")

    def _lose(self, reason: str) -> None:
        if not self._lost:
            self._end(reason)
            self._on_lost(f"{self._name}: {reason}")

    def _end(self, reason: str) -> None:
        """Nothing more is written or answered."""
        self._lost = reason
        waiting, self._waiting = self._waiting, {}
        for answered, _ in waiting.values():
            answered.set()


def in_words(command: IntEnum) -> str:
    return command.name.lower().replace("_", " ")
