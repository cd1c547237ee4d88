"""The model as its inversion sees it: f both ways, positive in the direction of pull, and G on the grid of pulses."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from stimrig.identify.dynamics.linear import SecondOrder
from stimrig.identify.dynamics.second_order import recursion, transition
from stimrig.identify.errors import BadModel, BadRequest
from stimrig.identify.inversion.reference import Reference
from stimrig.identify.model import Model
from stimrig.identify.problem.joint_surface import Surfaces
from stimrig.identify.problem.pulses import SAMPLES_A_PULSE, above_rest

OWED = 0.05
"""Most that one pulse leaves to those after it, as a share of the largest torque."""
NOTHING = 2e-3
"""A demand below this share of the largest one gets no pulse."""
WORTH = 0.02
"""A torque of more than this share of the largest one is worth a rise."""
PROBE_S = 3.0


@dataclass(frozen=True)
class Plant:
    """f, f⁻¹ and G of a model."""

    sign: float  # 1 or -1: of the record's torque where the muscle pulls
    width_us: np.ndarray  # the curve's table up to the widest pulse
    level_nm: np.ndarray  # f there, positive in the direction of pull
    inverse_nm: np.ndarray  # rising torques
    inverse_us: np.ndarray  # the smallest width that reaches each of them
    a: np.ndarray  # G on the grid of pulses, from 1
    b: np.ndarray  # from the pulse itself
    settled: int  # pulses after which a step has gone 95 % of its way
    rise_us: float | None  # largest rise from pulse to pulse
    whole: bool  # whether widths are whole µs
    shortest_us: float = 0.0  # a stimulator sends no narrower pulse

    @classmethod
    def of(
        cls, model: Model, reference: Reference, largest_us: float | None, rise_us: float | None, whole: bool,
        shortest_us: float = 0.0,
    ) -> Plant:  # fmt: skip
        """Make the plant of a model for a reference. Raises BadModel and BadRequest as `invert`."""
        rate_hz = reference.pulse_rate_hz
        if not isinstance(model.linear, SecondOrder):
            fix = "Fit with maximum-likelihood."
            raise BadModel(f"{model.method} has no second-order dynamics", place="linear", fix=fix)
        for name, limit in (("largest_us", largest_us), ("rise_us", rise_us)):
            if limit is not None and not 0.0 < limit < np.inf:
                raise BadRequest(f"{limit:g} µs", place=name, fix="Give a positive number, or leave it out.")
        if not 0.0 <= shortest_us < np.inf:
            raise BadRequest(f"{shortest_us:g} µs", place="shortest_us", fix="Give 0, or a positive number.")
        sign, width_us, level_nm = _curve(model, largest_us, whole)
        least_us = max(shortest_us, float(whole))
        for name, most_us in (("largest_us", float(width_us[-1])), ("rise_us", rise_us)):
            if most_us is not None and not ((np.floor(most_us) if whole else most_us) >= least_us):
                message = f"at most {most_us:g} µs, and the stimulator sends no pulse below {least_us:g} µs"
                raise BadRequest(message, place=name, fix="Allow more: with these limits nothing would be sent.")
        top = np.maximum.accumulate(np.maximum(level_nm, 0.0))
        first = np.r_[True, top[1:] > top[:-1]]
        linear = replace(model.linear, delay_s=model.linear.delay_s + _later(model, rate_hz, float(width_us[-1])))
        a, b = on_pulses(linear, rate_hz)
        step = recursion(a, np.cumsum(np.r_[b, np.zeros(round(30.0 * rate_hz))]))
        settled = 1 + int(np.max(np.flatnonzero(np.abs(step - 1.0) > 0.05), initial=0))
        return cls(sign, width_us, level_nm, top[first], width_us[first], a, b, settled, rise_us, whole, shortest_us)

    @property
    def largest_nm(self) -> float:
        """The largest demand, N·m."""
        return float(self.inverse_nm[-1])

    def linear(self, demand_nm: np.ndarray) -> np.ndarray:
        """G times a demand, from rest, shape (K,)."""
        return recursion(self.a, np.convolve(self.b, demand_nm)[: demand_nm.size])

    def rises(self, demand_nm: np.ndarray) -> np.ndarray | None:
        """Largest rise of the demand to each pulse, where it was `demand_nm` before, N·m, shape (K,); None: any."""
        if self.rise_us is None:
            return None
        before = np.r_[0.0, demand_nm[:-1]]
        width_us = np.maximum(np.interp(before, self.inverse_nm, self.inverse_us), self._ready_us)
        return np.maximum(np.interp(width_us + self.rise_us, self.inverse_us, self.inverse_nm) - before, 0.0)

    @cached_property
    def _ready_us(self) -> float:
        """Width at which a train waits for a rise: it gives next to no torque, and one rise from it leads to more.

        A fitted curve waves below its threshold. Behind a crest that no pulse within one rise exceeds, a train would
        stay on the crest; then it waits in the trough before the pulse that does.
        """
        assert self.rise_us is not None
        size_nm = np.abs(self.level_nm)
        quiet = np.maximum.accumulate(size_nm) <= NOTHING * self.largest_nm
        waits_us = float(self.width_us[quiet][-1])
        waits_us = waits_us if waits_us >= self.shortest_us else 0.0  # it would not be sent
        climbs = (self.inverse_nm > WORTH * self.largest_nm) & (self.inverse_us > waits_us)
        crests_us = np.r_[waits_us, self.inverse_us[climbs]]
        blocked = np.flatnonzero(np.diff(crests_us) >= self.rise_us)
        if not blocked.size:
            return waits_us
        end = int(np.searchsorted(self.width_us, crests_us[blocked[-1] + 1]))
        first = min(int(np.searchsorted(self.width_us, self.width_us[end] - self.rise_us, side="right")), end - 1)
        return max(float(self.width_us[first + np.argmin(size_nm[first:end])]), self.shortest_us)

    def widths(self, demand_nm: np.ndarray) -> np.ndarray:
        """f⁻¹ of a demand, µs, shape (K,); what rounding and the rise limit take, the pulses after give back."""
        wanted = np.where(demand_nm > NOTHING * self.largest_nm, np.minimum(demand_nm, self.largest_nm), 0.0)
        least_us = self._lead_in(np.interp(wanted, self.inverse_nm, self.inverse_us))
        most_owed, widest_us = OWED * self.largest_nm, float(self.width_us[-1])
        widths, owed, last = np.zeros(wanted.size), 0.0, 0.0
        for k, demand in enumerate(wanted):
            exact_us = float(np.interp(demand + owed, self.inverse_nm, self.inverse_us)) if demand > 0.0 else 0.0
            width = min(max(exact_us, least_us[k]), widest_us)
            if self.rise_us is not None:
                width = min(width, last + self.rise_us)
            if self.whole:
                width = min(round(width), int(widest_us), int(last + (self.rise_us or widest_us)))
            widths[k] = last = width if width >= self.shortest_us else 0.0
            given = float(np.interp(last, self.width_us, self.level_nm))
            owed = min(max(owed + demand - given, -most_owed), most_owed) if demand > 0.0 else 0.0
        return widths

    def _lead_in(self, widths_us: np.ndarray) -> np.ndarray:
        """Widths without torque that let a rise begin in time, µs, shape (K,)."""
        lead_in_us = np.zeros(widths_us.size)
        if self.rise_us is None:
            return lead_in_us
        coming = 0.0
        for k in range(widths_us.size - 1, -1, -1):
            lead_in_us[k] = min(max(coming - self.rise_us, 0.0), self._ready_us)
            lead_in_us[k] = max(lead_in_us[k], self.shortest_us) if lead_in_us[k] > 0.0 else 0.0
            coming = max(widths_us[k], lead_in_us[k])
        return np.floor(lead_in_us) if self.whole else lead_in_us


def _curve(model: Model, largest_us: float | None, whole: bool) -> tuple[float, np.ndarray, np.ndarray]:
    """The sign of the pull, and the curve's table up to the widest pulse, positive in that direction."""
    width_us, torque_nm = model.recruitment.table()
    sign = 1.0 if torque_nm[np.argmax(np.abs(torque_nm))] >= 0.0 else -1.0
    valid_us = float(model.valid_for.get("pulse_width_us", (0.0, width_us[-1]))[1])
    widest_us = min(valid_us, float(width_us[-1]), np.inf if largest_us is None else largest_us)
    widest_us = float(np.floor(widest_us)) if whole else widest_us
    inside = width_us < widest_us
    torque_nm = np.r_[torque_nm[inside], np.interp(widest_us, width_us, torque_nm)]
    width_us = np.r_[width_us[inside], widest_us]
    if not np.max(sign * torque_nm) > 1e-9:
        fix = "Allow wider pulses."
        raise BadModel(f"the model gives no torque up to {widest_us:g} µs", place="largest_us", fix=fix)
    return sign, width_us, sign * torque_nm


def _later(model: Model, rate_hz: float, widest_us: float) -> float:
    """By how much effects delay the model's answer to a step, s: the time between half-way points; at least 0."""
    if not model.effects:
        return 0.0
    size = round(PROBE_S * rate_hz)
    plain = model.with_(effects=())
    half_s = []
    surfaces = Surfaces.of(model.effects)
    at_reference = None if surfaces is None else np.full(size, surfaces.reference_rad)
    for variant in (model, plain):
        step = np.abs(above_rest(variant, np.full(size, widest_us), rate_hz, at_reference))
        peak = int(np.argmax(step))
        rising = np.maximum.accumulate(step[: peak + 1])
        half_s.append(float(np.interp(step[peak] / 2, rising, np.arange(peak + 1))) / rate_hz)
    return max(half_s[0] - half_s[1], 0.0)


def on_pulses(linear: SecondOrder, rate_hz: float) -> tuple[np.ndarray, np.ndarray]:
    """G from the demand of each pulse to the mean torque in its period: a and b of y = B(q)/A(q) w.

    The mean is that of the samples that `above_rest` takes.
    """
    phi, _ = transition(linear.time_constant_s, linear.damping, 1.0 / rate_hz)
    a = np.array([1.0, -np.trace(phi), np.linalg.det(phi)])
    size = max(int(np.ceil(linear.delay_s * rate_hz)), 0) + 5
    sampled = linear.step_response(np.arange(size * SAMPLES_A_PULSE) / (SAMPLES_A_PULSE * rate_hz))
    step = sampled.reshape(size, SAMPLES_A_PULSE).mean(axis=1)
    b = np.convolve(a, np.diff(step, prepend=0.0))[: size - 1]
    b[np.abs(b) < 1e-12] = 0.0
    return a, b * (a.sum() / b.sum())
