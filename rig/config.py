"""The rig file (TOML): devices, ports and tighter limits. `docs/rig-file.md` lists every key.

An error is one line: file, key, what is wrong, how to correct it.
"""

from __future__ import annotations

import argparse
import json
import math
import tomllib
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, StrictBool, ValidationError

from stimrig.rig import devices, limits
from stimrig.rig.acquire.health import DEFAULT_WATCH, Watch
from stimrig.rig.devices import DeviceSettings, Kind
from stimrig.rig.errors import ConfigError, RefusedError
from stimrig.rig.limits import Limit
from stimrig.rig.messages import Range


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class LimitSettings(_Table):
    """Tighter limits for this rig; a value beyond the hard limit has no effect. `true` is not a number."""

    model_config = ConfigDict(strict=True)

    pulse_width_us: float | None = Field(None, ge=0)
    current_ma: float | None = Field(None, ge=0)
    charge_per_phase_uc: float | None = Field(None, ge=0)
    charge_per_second_uc: float | None = Field(None, ge=0)
    pulse_rate_hz: float | None = Field(None, ge=1)
    torque_nm: float | None = Field(None, gt=0)
    torque_jump_nm: float | None = Field(None, gt=0)
    angle_rad: Range | None = None
    angle_jump_rad: float | None = Field(None, gt=0)
    duration_s: float | None = Field(None, gt=0)
    charge_per_test_uc: float | None = Field(None, ge=0)
    width_rise_us: float | None = Field(None, gt=0)
    rest_between_tests_s: float | None = Field(None, ge=0)
    rest_between_trains_s: float | None = Field(None, ge=0)

    def table(self) -> dict[str, Limit]:
        table = limits.HARD_LIMITS
        for name, value in self.model_dump(exclude_none=True).items():
            if name.startswith("rest_"):
                table = limits.at_least(table, name, value, "rig file")
            else:
                lo, hi = value if name == "angle_rad" else (-value if name == "torque_nm" else None, value)
                table = limits.tightened(table, name, hi, "rig file", lo)
        return table


class RigConfig(_Table):
    """A complete rig file, checked. `stimulator`, `load_cell` and `angle_sensor` are the chosen devices' settings.

    `clock_speed` is not a key of the rig file: all limits with a time are in rig seconds, so a faster clock would widen
    them. Only the emulator's JSON line sets it (see `for_emulator`).
    """

    data_dir: Path
    socket: Path
    clock_speed: float = Field(1.0, gt=0, le=100, strict=True)
    require_calibration: StrictBool = True
    stimulator: DeviceSettings
    load_cell: DeviceSettings
    angle_sensor: DeviceSettings | None = None
    limits: LimitSettings = LimitSettings.model_validate({})
    watch: Watch = DEFAULT_WATCH

    def public(self) -> dict[str, Any]:
        """The configuration as stored in every recording."""
        content = self.model_dump(mode="json")
        for kind, settings in self.devices().items():
            content[kind] = settings.model_dump(mode="json")
        return content

    def devices(self) -> dict[Kind, DeviceSettings]:
        """The settings of each device that this rig has, in the order in which they are opened."""
        devices: dict[Kind, DeviceSettings] = {"stimulator": self.stimulator, "load_cell": self.load_cell}
        return devices if self.angle_sensor is None else {**devices, "angle_sensor": self.angle_sensor}


EMULATOR_ONLY = "clock_speed"
PSEUDO_TERMINALS = Path("/dev/pts")


def load(path: Path, **overrides: Any) -> RigConfig:
    """Read a rig file.

    `path`: the TOML file; a relative DBC path in it is relative to the file's folder. `overrides`: values that override
    the file's: `data_dir`, `socket`. Raises ConfigError: one line with file, key and how to correct it.
    """
    try:
        content = tomllib.loads(path.read_text("utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}; give the path of a rig file (see docs/rig-file.md)") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not TOML: {error}") from None
    if EMULATOR_ONLY in content or overrides.get(EMULATOR_ONLY) is not None:
        place = f"{path}: {EMULATOR_ONLY}" if EMULATOR_ONLY in content else f"--clock-speed with {path}"
        raise ConfigError(
            f"{place}: only an emulator's clock may run faster than real time, and its own JSON line sets it; remove it"
        )
    for device in (content.get("load_cell"), content.get("angle_sensor")):
        if isinstance(device, dict) and str(device.get("dbc", "")).endswith(".dbc"):
            device["dbc"] = str(path.parent / device["dbc"])
    return check(content, str(path), **overrides)


EMULATOR_WATCH = {
    "stale_torque_s": 0.5,
    "missing_ack_s": 0.5,
    "clipped_torque_s": 10.0,
    "stale_angle_s": 0.5,
    "unmoved_torque_s": 3600.0,
}
"""No person is connected to an emulator, and it shares its processors with other programs. A pause of 0.1 s would stop
a real rig, but must not end a demo. A hidden saturated amplifier is there to be diagnosed, and stays saturated for up
to 6 s of the default ramp."""


def for_emulator(ready: str, **overrides: Any) -> RigConfig:
    """A rig for the emulator's devices, from the JSON line that it prints (or from a file with that line).

    The line may set the clock's speed and the watch, and needs no calibration. It must therefore never lead to a real
    stimulator: its port must be a pseudo-terminal.

    Raises ConfigError: the line is not valid, or its port is not a pseudo-terminal.
    """
    try:
        text = ready if ready.lstrip().startswith("{") else Path(ready).read_text("utf-8")
        line = json.loads(text)
        # the link stays valid after replugging, like udev's names by id
        stimulator, can = line.get("stimulator_link", line["stimulator"]), line["can"]
        cell = dict(line["load_cell"] if "cell" in line else {})
        sensor = _emulated_sensor(line["angle_sensor"]) if line.get("angle_sensor") else None
        # the link is missing while the emulated stimulator is unplugged: then use the port itself
        linked = Path(str(stimulator)).is_symlink() or Path(str(stimulator)).exists()
        place = Path(str(stimulator if linked else line["stimulator"])).resolve()
    except OSError as error:
        raise ConfigError(f"--emulator-json {ready}: {error.strerror}") from None
    except (ValueError, KeyError, AttributeError, TypeError, RecursionError) as error:
        raise ConfigError(f"--emulator-json: not the line that `stimrig emulate` prints ({error})") from None
    if place.parent != PSEUDO_TERMINALS:
        raise ConfigError(
            f"--emulator-json: stimulator {stimulator} is not a pseudo-terminal of an emulator; real "
            "devices need a rig file"
        )
    content: dict[str, Any] = {
        "clock_speed": line.get("speed", 1.0),
        "require_calibration": False,  # no person is connected to an emulator
        "watch": line.get("watch", EMULATOR_WATCH),
        "stimulator": {"device": line.get("stimulator_device", "p24"), "port": stimulator},
        "load_cell": {
            "device": "can_load_cell",
            "bus": can,
            "sample_rate_hz": line.get("sample_rate_hz", 1600.0),
            "sync": "Sync" if line.get("sync", True) else "",
            **cell,
        },
        "angle_sensor": sensor,
    }
    return check(content, "--emulator-json", **overrides)


def _emulated_sensor(line: dict[str, Any]) -> dict[str, Any]:
    """The rig-file settings of an emulator's angle sensor, as a calibration by two poses would find them."""
    of_the_cell = line["kind"] == "in_cell"
    return {
        "device": "can_angle_sensor",
        "of_the_cell": of_the_cell,
        "offset": float(line.get("offset_deg", 0.0)),
        "direction": int(line.get("direction", 1)),
        "radians_per_unit": math.radians(float(line.get("scale", 1.0))),
        **({} if of_the_cell else {"sample_rate_hz": float(line["rate_hz"])}),
    }


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the two options that name a rig; see `chosen`."""
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--config", type=Path, metavar="FILE", help="rig file (TOML), see docs/rig-file.md")
    source.add_argument("--emulator-json", metavar="LINE", help="JSON line of `stimrig emulate`, or a file with it")


def chosen(options: argparse.Namespace, **overrides: Any) -> RigConfig:
    """Load the rig that a command line names. Raises ConfigError."""
    if options.config is not None:
        return load(options.config, **overrides)
    return for_emulator(options.emulator_json, **overrides)


def check(content: dict[str, Any], place: str, **overrides: Any) -> RigConfig:
    """Check a rig file's content (see `load`)."""
    content = {**content, **{key: value for key, value in overrides.items() if value is not None}}
    for kind in ("stimulator", "load_cell"):
        content[kind] = _device(kind, content.get(kind), place)
    if content.get("angle_sensor") is not None:
        content["angle_sensor"] = _device("angle_sensor", content["angle_sensor"], place).with_cell(
            content["load_cell"]
        )
    try:
        config = RigConfig.model_validate(content)
        config.limits.table()
    except ValidationError as error:
        raise ConfigError(f"{place}: {_first(error, RigConfig)}") from None
    except RefusedError as error:
        raise ConfigError(f"{place}: limits: {error}") from None
    return config


def _device(kind: Kind, table: object, place: str) -> DeviceSettings:
    if not isinstance(table, dict):
        raise ConfigError(f"{place}: [{kind}] is missing; name its device, one of: {', '.join(devices.library(kind))}")
    try:
        settings: type[DeviceSettings] = devices.find(kind, table.get("device")).Settings
    except ConfigError as error:
        raise ConfigError(f"{place}: {error}") from None
    try:
        return settings.model_validate(table)
    except ValidationError as error:
        raise ConfigError(f"{place}: {kind}.{_first(error, settings)}") from None


def _first(error: ValidationError, model: type[BaseModel]) -> str:
    first = error.errors()[0]
    key = ".".join(str(part) for part in first["loc"])
    if first["type"] == "extra_forbidden":
        return f"{key}: unknown key (known here: {', '.join(model.model_fields)})"
    if first["type"] == "missing":
        return f"{key}: missing; see docs/rig-file.md"
    return f"{key}: {first['msg']}, not {first['input']!r}"
