"""Muscles with something hidden, by other equations than the library's: Runge-Kutta on calcium and force, three fatigue
compartments, half-sine efforts. So that no test of the diagnosis marks its own homework."""

from __future__ import annotations

import numpy as np

from stimrig.identify.records.record import Record

FINE_HZ = 1000
TOP_US = 300.0


def protocol(rng: np.random.Generator, validate: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """Pulse widths at 40 a second, and segment names."""
    prbs = np.repeat(rng.integers(0, 2, 80), 6)[:440] * TOP_US
    up = np.linspace(0, TOP_US, 180, endpoint=False)
    levels = np.repeat(rng.uniform(0, TOP_US, 18) * (rng.random(18) > 0.15), 20)
    parts = [
        ("rest", np.zeros(80)),
        ("prbs", prbs),
        ("rest", np.zeros(100)),
        ("ramp", np.r_[up, TOP_US - up]),
        ("rest", np.zeros(80)),
    ]
    if validate:
        parts.append(("validate", levels))
    return np.concatenate([w for _, w in parts]), np.concatenate([[n] * w.size for n, w in parts])


def recruited(width_us: np.ndarray) -> np.ndarray:
    """Hill's curve with a threshold, N·m."""
    part = np.maximum(width_us - 45.0, 0.0) / 75.0
    return 7.0 * part**2.2 / (1.0 + part**2.2)


def muscle(widths: np.ndarray, hidden: str = "") -> np.ndarray:
    """Torque at 1 kHz of two lags in a row, with one thing hidden in it."""
    fine = FINE_HZ // 40
    time_s = np.arange(widths.size * fine) / FINE_HZ
    u = np.repeat(widths, fine)
    if hidden == "threshold_drift":
        u = np.where(u > 0, u - 0.9 * time_s, 0.0)
    drive = recruited(u)
    if hidden == "electromechanical_delay":
        drive = np.r_[np.zeros(45), drive][: drive.size]
    calcium = force = 0.0
    active = fatigued = 0.0
    out = np.empty(drive.size)
    h = 1.0 / FINE_HZ
    for i, w in enumerate(drive):
        slow = 0.16
        if hidden == "asymmetric_relaxation":
            slow = 0.12 if calcium > force else 0.2
        if hidden == "fatigue":
            # Xia, Frey-Law: the recruited fibres tire and recover; what is tired gives nothing.
            active = w / 7.0 * (1.0 - fatigued)
            fatigued += h * (0.03 * active - 0.008 * fatigued)
            w = w * (1.0 - fatigued)
        calcium += h * (w - calcium) / 0.05
        force += h * (calcium - force) / slow
        out[i] = force
    if hidden == "output_saturation":
        out = 6.0 * np.tanh(out / 6.0)
    if hidden == "voluntary_effort":
        for start, length, height in ((6.2, 1.1, 1.1), (13.4, 0.9, 0.8), (18.2, 1.3, 0.9)):
            phase = np.clip((time_s - start) / length, 0.0, 1.0)
            out = out + height * np.sin(np.pi * phase) ** 2
    if hidden == "tremor":
        out = out + 0.25 * np.sin(2 * np.pi * 5.3 * time_s + 0.8 * np.sin(0.4 * time_s))
    if hidden == "baseline_drift":
        out = out + 0.03 * time_s
    return out


def record(
    hidden: str = "", seed: int = 1, rate_hz: int = 200, noise_nm: float = 0.04, ar1: float = 0.0, validate: bool = True
) -> Record:
    """A record of such a muscle."""
    rng = np.random.default_rng(seed)
    widths, names = protocol(rng, validate)
    every = FINE_HZ // rate_hz
    torque = muscle(widths, hidden)[::every]
    time_s = np.arange(torque.size) / rate_hz
    noise = rng.standard_normal(torque.size) * noise_nm
    if ar1:
        from scipy.signal import lfilter

        rho = ar1 ** (40.0 / rate_hz)
        noise = np.asarray(lfilter([np.sqrt(1 - rho**2)], [1.0, -rho], noise))
    measured = torque + noise
    if hidden == "mains_hum":
        measured = measured + 0.2 * np.sin(2 * np.pi * 50.03 * time_s + 0.4)
    if hidden == "sensor_clipping":
        measured = np.minimum(measured, 4.9)
    place = np.minimum((time_s * 40 + 1e-9).astype(int), widths.size - 1)
    return Record.from_arrays(time_s, widths[place], measured, names[place])
