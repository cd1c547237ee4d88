"""The text of a rig file, each key with a comment that explains it."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping

from stimrig.rig.setup.questions import LIMITS, channels_of

HEAD = """\
# The rig file: which devices this rig has, and which tighter limits. docs/rig-file.md describes every key.
# Check the file:   python -m stimrig.rig --config {path} --check
# Check the rig:    stimrig rig check --rig {path}
"""
UNITS = {"pulse_width_us": "µs, a phase", "current_ma": "mA", "torque_nm": "N·m, either way"}


def rig_file(answers: Mapping[str, str], path: str) -> str:
    """The file. Raises ConfigError: the channels cannot be read."""
    return "\n".join(
        [
            HEAD.format(path=" ".join(path.split())),
            *_top(answers),
            *_stimulator(answers),
            *_cell(answers),
            *_limits(answers),
        ]
    )


def _top(answers: Mapping[str, str]) -> list[str]:
    return [
        _key("data_dir", answers["data-dir"], "journals, recordings, and what the last check found"),
        _key("socket", answers["socket"], "where the service reaches the rig"),
        "require_calibration = true" + _comment("no test without limits found with this person today"),
        "require_check = false" + _comment("true: no test without a valid `stimrig rig check`"),
    ]


def _stimulator(answers: Mapping[str, str]) -> list[str]:
    channels = channels_of(answers["channels"], answers["stimulator"])
    lines = [
        "",
        "[stimulator]",
        _key("device", answers["stimulator"], "name of a file in rig/devices/"),
        _key("port", answers["port"], "a name by udev stays the same when cables are moved"),
    ]
    words = {"channel": "output, as the case names it", "connector": "of the P24: 1 yellow, 2 green"}
    if len(channels) == 1 and not channels[0][0]:
        return [*lines, *[f"{key} = {value}{_comment(words[key])}" for key, value in channels[0][1].items()]]
    for name, output in channels:
        lines += [
            "",
            "[[stimulator.channels]]",
            _key("name", name, "by which tests and recordings call it"),
            _key("muscle", f"m. {name}", "in words: correct it"),
            _key("side", "right", "left or right: correct it"),
            *[f"{key} = {value}{_comment(words[key])}" for key, value in output.items()],
        ]
    return lines


def _cell(answers: Mapping[str, str]) -> list[str]:
    can, none = answers["can"], {"-": ""}
    slcan = can.startswith("/")
    bus = f'{{ interface = "{"slcan" if slcan else "socketcan"}", channel = {_text(can)} }}'
    bus = bus.replace(" }", ", bitrate = 1000000 }") if slcan else bus
    return [
        "",
        "[load_cell]",
        _key("device", "can_load_cell", "any cell on CAN that a DBC file describes"),
        f"bus = {bus}{_comment('arguments of python-can; the bit rate of socketcan is set by the system')}",
        _key("dbc", answers["dbc"], "a packaged description, or the path of your cell's DBC file"),
        _key("signal", answers["signal"], "the torque, or the force"),
        f"scale_nm = {float(answers['scale-nm'])}{_comment('N·m for one unit; negative turns the sign')}",
        _key("counter", none.get(answers["counter"], answers["counter"]), "empty: the cell counts nothing"),
        _key("sync", none.get(answers["sync"], answers["sync"]), "empty: the stimulator's sync line is not wired"),
        f"sample_rate_hz = {float(answers['sample-rate-hz'])}{_comment('what the cell is set to')}",
    ]


def _limits(answers: Mapping[str, str]) -> list[str]:
    lines = ["", "[limits]" + _comment("tighter than the hard limits; a value beyond those has no effect")]
    for name in LIMITS:
        value = float(answers["limit-" + name.replace("_", "-")])
        lines.append(f"{name} = {value:g}{_comment(UNITS.get(name, 's, at least, from pulse to pulse of two tests'))}")
    return [*lines, ""]


def _key(name: str, value: str, comment: str) -> str:
    return f"{name} = {_text(value)}{_comment(comment)}"


def _text(value: str) -> str:
    """A string of TOML: those of JSON are, but for a character that neither may hold as it is."""
    return re.sub("\x7f", r"\\u007F", json.dumps(value, ensure_ascii=False))


def _comment(words: str) -> str:
    return f"  # {words}"
