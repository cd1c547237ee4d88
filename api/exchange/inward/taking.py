"""A record of a foreign file: what cannot be known is asked for, and what was taken is told.

Nothing is guessed: which signal is the torque, its unit and sign, a force's lever arm, the pulses' widths, rate and
clock, and what the segments are come from an option, from a person at a terminal, or from a file of our own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from stimrig.api.exchange.inward.foreign import Foreign, Signal, plain
from stimrig.api.exchange.inward.timing import between, coded, held, pulse_rate, pulses_in_force, same
from stimrig.api.whole_file import sha256_of
from stimrig.identify.errors import BadRecord, BadRequest
from stimrig.identify.records import bounds, columns
from stimrig.identify.records.assemble import record_of
from stimrig.identify.records.file_content import FileContent, check_numbers, check_widths, without_holes
from stimrig.identify.records.record import Record, Source

Ask = Callable[[str, str, Sequence[str]], str]
"""Asks a person: the option that would have said it, the question, the choices. Raises BadRequest where nobody is."""
FORCES_N = {"n": 1.0, "kn": 1e3, "mn": 1e-3, "kgf": 9.80665, "lbf": 4.4482216152605}
NONE = "none"
MOST_SHOWN = 12


@dataclass
class Taking:
    """One import: a file, the answers that were given, and whom to ask for the others."""

    path: Path
    foreign: Foreign
    given: Mapping[str, str]  # answers by option, without the dashes; `torque_nm` and others as `--map` says them
    ask: Ask
    taken: dict[str, Any] = field(default_factory=dict)  # what was taken, for who looks at it later

    def answer(self, option: str, question: str, choices: Sequence[str] = ()) -> str:
        """What was given, what our own file says, or what a person says."""
        said = self.given.get(option) or self.foreign.own.get(option)
        if said is None:
            shown = f"--{option}" if option not in columns.TARGETS else f"--map {option}="
            said = self.ask(shown, question, choices)
        return said

    def number(self, option: str, question: str, lowest: float, highest: float) -> float:
        """A number that was asked for. Raises BadRequest: it is none, or lies outside."""
        said = self.answer(option, question)
        try:
            value = float(said)
        except ValueError:
            value = float("nan")
        if not (lowest <= value <= highest):
            raise BadRequest(f"{said!r} is not in {lowest:g} to {highest:g}", place=f"--{option}", fix=question)
        return value

    def record(self) -> Record:
        """The record. Raises BadRecord: the file's content; BadRequest: an answer is missing, or cannot be used."""
        torque, torque_nm = self._torque()
        found = {"time_s": torque.time_s, "torque_nm": torque_nm}
        found |= self._further(torque)
        names, code = self._segments(torque)
        inside = np.ones(torque.time_s.size, bool) if code is None else code >= 0
        if not inside.any():
            raise BadRecord("no sample inside a segment", place=str(self.path), fix="Give --segments none.")
        rate_hz, widths = self._widths(torque)
        found |= widths
        found |= {} if code is None else {"segment": code}
        kept = {name: column[inside] for name, column in found.items()}
        self.taken["samples"] = {"in the file": int(torque.time_s.size), "outside of segments": int(np.sum(~inside))}
        return self._made(kept, names, rate_hz)

    def _made(self, found: dict[str, np.ndarray], names: list[str], rate_hz: float) -> Record:
        about = self.foreign.about
        source = Source(
            self.path.name, str(about.get("recording_id") or ""), sha256_of(self.path), notes=self.foreign.told,
            participant=str(about.get("participant") or ""),
        )  # fmt: skip
        content = FileContent(found, names, str(self.path), lambda row, name: f"{name}, sample {row}", source, rate_hz)
        for name in names:
            bounds.check_name(name, f"{self.path}, segments")
        bounds.check_size(found["time_s"].size, str(self.path))
        if not self.foreign.own:
            return record_of(content)
        check_numbers(content)  # our own times and widths are exact: nothing is made even
        content = without_holes(content)
        check_widths(content)
        time_s = content.columns["time_s"]
        if (bad := np.flatnonzero(~(np.diff(time_s) > 0))).size:
            raise BadRecord("time runs backwards", place=content.at(int(bad[0]) + 1), fix="Give the file as exported.")
        bounds.check_span(time_s, content.at(time_s.size - 1))
        bounds.check_sampling(1 / float(np.median(np.diff(time_s))), content.at(0))
        return content.record()

    def signal(self, target: str, question: str, among: Sequence[Signal] | None = None) -> tuple[Signal, str]:
        """The signal that is meant, and its unit. Raises BadRequest: there is no such signal, or no unit."""
        choices = [one.shown for one in (self.foreign.signals if among is None else among)]
        said = self.answer(target, question, choices).strip()
        asked = columns.Asked(target, said)
        by_name = {one.name: one for one in self.foreign.signals}
        found, unit = (by_name[said], "") if said in by_name else (by_name.get(asked.name), asked.unit)
        if found is None:
            here = ", ".join(list(by_name)[:MOST_SHOWN])
            raise BadRequest(
                f"no signal is called {asked.name!r}", place=f"{self.path}, --map {target}", fix=f"It has: {here}."
            )
        unit = plain(unit or found.unit)
        known = columns.SHOWN.get(target)
        if known and not unit and not np.isnan(found.values).all():
            unit = self.ask(f"--map {target}={found.name}:UNIT", f"which unit has {found.name}?", known)
        self.taken[target] = {"signal": found.name, "unit": unit, "samples": int(found.time_s.size)}
        return found, unit

    def _factor(self, target: str, unit: str) -> float:
        factor = columns.unit_factor(target, unit)
        if factor is None:
            known = ", ".join(columns.SHOWN[target])
            raise BadRequest(
                f"the unit {unit!r} is not known", place=f"--map {target}", fix=f"Give NAME:UNIT, one of {known}."
            )
        return factor

    def _torque(self) -> tuple[Signal, np.ndarray]:
        sampled = [one for one in self.foreign.signals if not one.events]
        found, unit = self.signal("torque_nm", "which signal is the torque (NAME:UNIT)?", sampled)
        force = FORCES_N.get(columns.plain_unit(unit)) if unit != "MN" else None
        if force is not None:
            arm_m = self.number("lever-arm-m", f"{found.name} is a force: its lever arm in m?", 1e-3, 10.0)
            self.taken["torque_nm"]["lever_arm_m"] = arm_m
            factor = force * arm_m
        else:
            factor = self._factor("torque_nm", unit)
        sign = self.answer(
            "sign", "is the torque of the stimulated muscle positive (+1) or negative (-1) in it?", ("+1", "-1")
        )
        if sign not in ("+1", "-1", "1"):
            raise BadRequest(f"{sign!r} is no sign", place="--sign", fix="Give +1 or -1.")
        self.taken["torque_nm"] |= {"factor": factor, "sign": int(sign)}
        values = found.values if factor == 1 else found.values * factor
        return found, values if int(sign) > 0 else -values

    def _further(self, torque: Signal) -> dict[str, np.ndarray]:
        """Columns that are taken only where somebody says so, at the times of the torque."""
        made, outside = {}, None if self.foreign.own else np.nan  # ours says in `doubted` where no angle is known
        for target in ("angle_rad", "velocity_rad_s", "late_s", "doubted"):
            if target in self.given or target in self.foreign.own:
                found, unit = self.signal(target, "")
                factor = 1.0 if target == "doubted" else self._factor(target, unit)
                values = found.values * factor if factor != 1 else found.values
                made[target] = values if same(found, torque) else between(found.time_s, values, torque.time_s, outside)
        return made

    def _segments(self, torque: Signal) -> tuple[list[str], np.ndarray | None]:
        """The segments' names and an index into them for each sample, −1 for none; no index where nothing is said."""
        spans = {one.name: one for one in self.foreign.spans}
        said = NONE
        if spans or "segments" in self.given:
            choices = (*spans, NONE)
            said = self.answer("segments", "what names the segments (rows of `validate` are held out)?", choices)
        if said != NONE and said not in spans:
            here = ", ".join((*spans, NONE))
            raise BadRequest(
                f"no segments are called {said!r}", place=f"{self.path}, --segments", fix=f"Give one of: {here}."
            )
        self.taken["segments"] = said if said != NONE else "none: found from the pulse widths, nothing is held out"
        if said == NONE:
            return [], None
        if spans[said].clock != torque.clock:
            message = f"{said} and {torque.name} have clocks of their own"
            raise BadRequest(message, place=f"{self.path}, --segments", fix="Give --segments none.")
        return coded(spans[said], torque.time_s)

    def _widths(self, torque: Signal) -> tuple[float, dict[str, np.ndarray]]:
        """The pulse rate; the width in force at each sample of the torque, and what it was late where that is known."""
        found, unit = self.signal("pulse_width_us", "which signal is the pulse width (NAME:UNIT)?")
        time_s = found.time_s + self._offset(found, torque)
        if np.isnan(found.values).all():
            width = self.number(
                "pulse-width-us", f"{found.name} has marks without widths: how wide is a pulse, µs?", 1, 1e4
            )
            values = np.full(time_s.size, width)
        else:
            factor = self._factor("pulse_width_us", unit)
            values = found.values if factor == 1 else found.values * factor
        if not found.events:
            rate_hz = self.number("pulse-rate-hz", "how many pulses a second?", *bounds.PULSE_RATES_HZ)
            self.taken["pulse_rate_hz"] = rate_hz
            return rate_hz, {"pulse_width_us": values if same(found, torque) else held(time_s, values, torque.time_s)}
        return self._events(time_s, values, torque)

    def _offset(self, found: Signal, torque: Signal) -> float:
        if found.clock == torque.clock and "clock-offset-s" not in self.given:
            return 0.0
        question = f"{found.name} and {torque.name} have clocks of their own: how many s to add to the pulses' times?"
        offset_s = self.number("clock-offset-s", question, -1e10, 1e10)
        self.taken["clock_offset_s"] = offset_s
        return offset_s

    def _events(self, time_s: np.ndarray, width_us: np.ndarray, torque: Signal) -> tuple[float, dict[str, np.ndarray]]:
        """Pulses at their own times: each on its even slot, and how late it was."""
        good = np.isfinite(time_s) & np.isfinite(width_us)
        time_s, width_us = time_s[good], width_us[good]
        if time_s.size < 2 or not (np.diff(time_s) > 0).all():
            raise BadRecord(
                "pulses do not follow one another",
                place=f"{self.path}, {self.taken['pulse_width_us']['signal']}",
                fix="Give each pulse once, in the order of time.",
            )
        said = self.given.get("pulse-rate-hz") or self.foreign.own.get("pulse-rate-hz")
        rate_hz = (
            pulse_rate(time_s)
            if said is None
            else self.number("pulse-rate-hz", "pulses a second?", *bounds.PULSE_RATES_HZ)
        )
        bounds.check_rate(rate_hz, f"{self.path}, pulse rate")
        self.taken["pulse_rate_hz"], self.taken["pulses"] = rate_hz, int(time_s.size)
        found = pulses_in_force(time_s, width_us, rate_hz, torque.time_s)
        if found is None:
            message = f"two pulses in one interval of {rate_hz:g} pulses/s"
            raise BadRecord(message, place=str(self.path), fix="Give the true --pulse-rate-hz.")
        return rate_hz, found
