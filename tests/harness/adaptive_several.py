"""Simulated muscles at one joint that an adaptive test plays on, of the plainest equations; their curves are known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stimrig.identify.muscles import Channel, JointRecord
from stimrig.identify.muscles.adaptive import Asked, Decision, decide
from tests.harness.two_muscles import FINE_HZ, NAMES, PULSES_HZ, RATE_HZ, respond, sigmoid


@dataclass(frozen=True)
class Muscle:
    """A sigmoid and critically damped dynamics."""

    torque_nm: float  # at the largest width, with its sign
    middle_us: float
    steep_us: float
    period_s: float

    def curve_nm(self, width_us: np.ndarray) -> np.ndarray:
        """Torque at widths that are held."""
        return self.torque_nm * sigmoid(np.asarray(width_us, float), self.middle_us, self.steep_us)


Joint = tuple[Muscle, ...]
CHANNELS = (*NAMES, "brachialis")
FLEXOR, EXTENSOR = Muscle(8.0, 120.0, 9.0, 0.12), Muscle(-6.0, 160.0, 26.0, 0.2)
THIRD = Muscle(5.0, 140.0, 15.0, 0.15)


def recorded(joint: Joint, widths_us: np.ndarray, noise_nm: float = 0.05, seed: int = 1) -> JointRecord:
    """What is measured while widths of shape (P, C) are played."""
    fine = np.repeat(widths_us, FINE_HZ // PULSES_HZ, axis=0).T
    late = [place * FINE_HZ // PULSES_HZ // len(joint) for place in range(len(joint))]
    fine = np.stack([np.r_[np.zeros(by), own[: own.size - by]] for by, own in zip(late, fine, strict=True)])
    torque = sum(respond(one.curve_nm(own), one.period_s) for one, own in zip(joint, fine, strict=True))
    step = FINE_HZ // RATE_HZ
    torque = np.asarray(torque)[::step]
    noise = noise_nm * np.random.default_rng(seed).standard_normal(torque.size)
    channels = [Channel(name, offset_s=by / FINE_HZ) for name, by in zip(CHANNELS, late, strict=False)]
    own: dict[str, np.ndarray] = dict(zip(CHANNELS, fine[:, ::step], strict=False))
    return JointRecord.from_arrays(channels, np.arange(torque.size) / RATE_HZ, own, torque + noise)


def dose_nm_s(joint: Joint, widths_us: np.ndarray) -> np.ndarray:
    """True torque-time of each muscle, of widths of shape (P, C)."""
    pairs = zip(joint, widths_us.T, strict=True)
    return np.array([float(np.sum(np.abs(one.curve_nm(own)))) / PULSES_HZ for one, own in pairs])


@dataclass
class Played:
    """A test that has ended."""

    widths_us: np.ndarray  # shape (P, C)
    decisions: list[Decision]
    record: JointRecord

    @property
    def last(self) -> Decision:
        """How it ended."""
        return self.decisions[-1]


def play(joint: Joint, asked: Asked, noise_nm: float = 0.05, seed: int = 1) -> Played:
    """A whole test."""
    widths, decisions, record = np.zeros((0, len(joint))), [], None
    while True:
        decisions.append(decide(record, widths, asked))
        piece = decisions[-1].piece
        if piece is None:
            assert record is not None
            return Played(widths, decisions, record)
        widths = np.concatenate([widths, piece.pulse_width_us])
        record = recorded(joint, widths, noise_nm, seed)
