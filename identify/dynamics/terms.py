"""Two lags in a row, parts of which change in proportion to what happened; with exact derivatives; compiled.

a' = k1 (w - a + κ (a - y)), y' = k2 (a - y): a follows the drive w, the torque y follows a. With constant rates this is
T² y'' + 2 ζ T y' + y = w, where T² = 1/(k1 k2) and 2 ζ T = 1/k1 + (1 - κ)/k2. A term *place <- driver, late by τ* adds
size·x to the exponent z of its place: x' = (driver - x)/τ. The states are found by the trapezoidal rule in `PARTS`
steps of a pulse interval, during which places and drivers' lags hold what they were at the step's start.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numba import njit

PARTS = 3
"""Steps within a pulse interval."""
QUICK_S = 0.1
"""A rate of the torque counts as the change in this time, as a share of y_max."""
EDGE = 0.02
"""Change in `QUICK_S` over which a rise turns into a fall."""
LARGEST = 3.0
"""Bound of an exponent: tanh bends it there."""
LEAST_ROOT = 0.01
"""Root of ζ² - 1 below which the two lags are no longer told apart in a derivative."""
REACH = 1.35
"""The curve's table goes up to so many times the largest width."""


class Place(IntEnum):
    """What a term changes."""

    WIDTH = 0  # the width that acts: u exp(z)
    STRENGTH = 1  # the drive before the lags: f exp(z)
    FIRST_RATE = 2  # k1 exp(z), that of the quicker lag
    SECOND_RATE = 3  # k2 exp(z)
    TORQUE = 4  # torque at the cell: y + y_max z
    FACTOR = 5  # y exp(z)


class Driver(IntEnum):
    """What drives a term, as a share; with a lag τ, but for those behind `SQUARE`, which have a reach or nothing."""

    DRIVE = 0  # the drive f(u) over y_max
    TORQUE = 1  # y over y_max
    RISE = 2  # the torque's rise
    FALL = 3  # its fall
    PULSES = 4  # 1 under pulses
    SQUARE = 5  # (y/y_max)², at once
    TORQUE_PLAY = 6  # y/y_max behind play of a reach: a Prandtl-Ishlinskii operator
    WIDTH_PLAY = 7  # the width over the largest, behind play


def lags_of(time_constant_s: float, damping: float) -> tuple[np.ndarray, np.ndarray]:
    """Return k1, k2, 1/s, and κ, shape (3,), and ln k1, ln k2 and κ by ln T and ln ζ, shape (2, 3)."""
    root = np.sqrt(max(damping * damping - 1.0, 0.0))
    both = max(damping, 1.0)
    lags = np.array([1.0 / (both - root), 1.0 / (both + root), 2.0 * max(1.0 - damping, 0.0) * time_constant_s])
    apart = damping / max(root, LEAST_ROOT) if damping > 1.0 else 0.0
    return lags / time_constant_s, np.array([[-1.0, -1.0, 0.0], [apart, -apart, -2.0 * damping * (damping < 1.0)]])


@njit(cache=True, nogil=True)
def _cell(table, place):  # pragma: no cover
    """Value of a table at a place between its rows, and its slope."""
    low = min(int(place), table.size - 2)
    return table[low] + (place - low) * (table[low + 1] - table[low]), table[low + 1] - table[low]


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def run_terms(
    drive, drives, width, widths, present, rest_s, curve, curves, owner, lags, lag_slopes, places, drivers, sizes, lag,
    own, begins, initial, initials, scale_nm, step_s,
):  # pragma: no cover  # fmt: skip
    """Torque, N·m, and its rate at the boundaries, (K + 1,), and their derivatives by P parameters, (P, K + 1).

    Parameters
    ----------
    drive, drives
        The mean drive of each interval, (K,), and its derivatives, (P, K).
    width, widths, present, rest_s
        Width over the largest, (K,), and its derivatives by the first W parameters, (W, K); share of the interval in
        which a pulse acts, and further rest before it, s, (K,).
    curve, curves, owner
        The recruitment curve at G even widths up to `REACH`, (G,); its derivatives by its coefficients, (C, G), and
        which of the parameters these are, (C,).
    lags, lag_slopes
        k1, k2, 1/s, and κ, (3,); derivatives of ln k1, ln k2 and κ, (P, 3).
    places, drivers, sizes, lag, own
        Of each term, (J,): a `Place`, a `Driver`, its size, its lag, s, or its reach; and the parameters that are its
        size and the logarithm of its lag, (J, 2), -1 for none. The sizes of active terms come first.
    begins, initial, initials
        Intervals at which the torque and its rate are those of `initial`, (B,) and (B, 2); derivatives, (P, B, 2).
    """
    count, size, terms = len(drives), drive.size, places.size
    torque, rate = np.zeros(size + 1), np.zeros(size + 1)
    torques, rates = np.zeros((size + 1, count)), np.zeros((size + 1, count))
    active = 0
    for j in range(terms):
        if sizes[j] != 0.0:
            active = j + 1
    x, dx = np.zeros(terms), np.zeros((active, count))
    z, zt, dz = np.zeros(6), np.zeros(6), np.zeros((6, count))
    y, a, dy, da, k2 = 0.0, 0.0, np.zeros(count), np.zeros(count), lags[1]
    dw, values, slopes = np.zeros(count), np.zeros(8), np.zeros((8, count))
    by_drive, by_torque, by_rise = slopes[Driver.DRIVE], slopes[Driver.TORQUE], slopes[Driver.RISE]
    by_fall, by_first, by_second = slopes[Driver.FALL], dz[Place.FIRST_RATE], dz[Place.SECOND_RATE]
    lag_first, lag_second, lag_kappa = lag_slopes[:, 0].copy(), lag_slopes[:, 1].copy(), lag_slopes[:, 2].copy()
    driven = np.zeros(count)
    small = 1.0 / scale_nm
    h = step_s / PARTS
    decay = np.exp(-h / lag)
    used = np.zeros(6, np.bool_)
    for j in range(terms):
        used[places[j]] = True
    grain = (curve.size - 1) / REACH
    part = 0
    for k in range(size):
        if rest_s[k] > 0.0:
            for j in range(terms):
                if drivers[j] < Driver.SQUARE:
                    x[j] *= np.exp(-rest_s[k] / lag[j])
                    if j < active:
                        dx[j] *= np.exp(-rest_s[k] / lag[j])
        if part < begins.size and k == begins[part]:
            for j in range(terms):  # a play starts anew, as in a record that is predicted; a kept one passes for a zero
                if drivers[j] > Driver.SQUARE:
                    x[j] = 0.0
                    if j < active:
                        dx[j] = 0.0
            y = initial[part, 0]
            a = y + initial[part, 1] / lags[1]
            for p in range(count):
                dy[p] = initials[p, part, 0]
                da[p] = dy[p] + initials[p, part, 1] / lags[1] - initial[part, 1] / lags[1] * lag_slopes[p, 1]
            torque[k], rate[k] = y, initial[part, 1]
            torques[k], rates[k] = dy, initials[:, part, 1]
            part += 1
        for p in range(count):
            driven[p] = drives[p, k]
        for _ in range(PARTS):
            # ---- exponents of the places
            for q in range(6):
                z[q] = 0.0
                if used[q]:
                    dz[q] = 0.0
            for j in range(terms):
                z[places[j]] += sizes[j] * x[j]
                if j < active and sizes[j] != 0.0:
                    row, moving, much = dz[places[j]], dx[j], sizes[j]
                    for p in range(count):
                        row[p] += much * moving[p]
                if own[j, 0] >= 0:
                    dz[places[j], own[j, 0]] += x[j]
            for q in range(4):
                zt[q] = LARGEST * np.tanh(z[q] / LARGEST)
                if used[q] and z[q] != 0.0:
                    dz[q] *= 1.0 - (zt[q] / LARGEST) ** 2
            # ---- what drives the lags
            w = drive[k]
            for p in range(count):
                dw[p] = driven[p]
            if used[Place.WIDTH] and width[k] > 0.0:
                place = width[k] * np.exp(zt[Place.WIDTH]) * grain
                there, steep = _cell(curve, min(place, curve.size - 1.0))
                here, steep_here = _cell(curve, width[k] * grain)
                gain = w / here if abs(here) > 0.02 * scale_nm else present[k]
                w += gain * (there - here)
                inside = steep * place if place < curve.size - 1.0 else 0.0
                ratio = there / here if abs(here) > 0.02 * scale_nm else 1.0
                row = dz[Place.WIDTH]
                for p in range(count):
                    dw[p] = dw[p] * ratio + gain * inside * row[p]
                for p in range(len(widths)):
                    dw[p] += gain * (inside / width[k] - steep_here * grain * ratio) * widths[p, k]
                for c in range(owner.size):  # exact for the curve's coefficients
                    p = owner[c]
                    own_there = _cell(curves[c], min(place, curve.size - 1.0))[0]
                    own_here = _cell(curves[c], width[k] * grain)[0]
                    dw[p] += gain * (own_there - own_here * ratio)
            if used[Place.STRENGTH]:
                factor = np.exp(zt[Place.STRENGTH])
                w *= factor
                row = dz[Place.STRENGTH]
                for p in range(count):
                    dw[p] = factor * dw[p] + w * row[p]
            k1, k2 = lags[0] * np.exp(zt[Place.FIRST_RATE]), lags[1] * np.exp(zt[Place.SECOND_RATE])
            # ---- a trapezoidal step of y' = k2 (a - y), a' = k1 (w - (1 - κ) a - κ y)
            i, g, m, n = 0.5 * h * k2, 0.5 * h * k1, 1.0 - lags[2], lags[2]
            ry = (1.0 - i) * y + i * a
            ra = -g * n * y + (1.0 - g * m) * a + 2.0 * g * w
            inverse = 1.0 / ((1.0 + i) * (1.0 + g * m) + i * g * n)
            new_y = inverse * ((1.0 + g * m) * ry + i * ra)
            new_a = inverse * ((1.0 + i) * ra - g * n * ry)
            mid_y, mid_a = 0.5 * (y + new_y), 0.5 * (a + new_a)
            pull_y, pull_a = 2.0 * i * (mid_a - mid_y), 2.0 * g * (w - m * mid_a - n * mid_y)
            pull_k = 2.0 * g * (mid_a - mid_y)
            c1, c2, c3, c4, quick = (1.0 - i), -g * n, (1.0 - g * m), 2.0 * g, QUICK_S * small / h
            d1, d2, d3, d4 = inverse * (1.0 + g * m), inverse * i, inverse * (1.0 + i), -inverse * g * n
            for p in range(count):
                sy = c1 * dy[p] + i * da[p] + pull_y * (lag_second[p] + by_second[p])
                sa = (
                    c2 * dy[p] + c3 * da[p] + c4 * dw[p] + pull_a * (lag_first[p] + by_first[p]) + pull_k * lag_kappa[p]
                )
                next_y = d1 * sy + d2 * sa
                da[p] = d3 * sa + d4 * sy
                by_torque[p] = 0.5 * small * (dy[p] + next_y)
                by_rise[p] = quick * (next_y - dy[p])
                dy[p] = next_y
            # ---- the drivers
            change = (new_y - y) * QUICK_S / (h * scale_nm)
            root = np.sqrt(change * change + EDGE * EDGE)
            values[Driver.DRIVE], values[Driver.PULSES] = drive[k] / scale_nm, present[k]
            values[Driver.TORQUE] = mid_y / scale_nm
            values[Driver.RISE] = 0.5 * (root + change) - 0.5 * EDGE
            values[Driver.FALL] = 0.5 * (root - change) - 0.5 * EDGE
            up = 0.5 * (1.0 + change / root)
            for p in range(count):
                by_fall[p] = (up - 1.0) * by_rise[p]
                by_rise[p] *= up
                by_drive[p] = driven[p] * small
            y, a = new_y, new_a
            for j in range(terms):
                d, mine = drivers[j], own[j, 1]
                if d < Driver.SQUARE:
                    away = x[j] - values[d]
                    x[j] = values[d] + away * decay[j]
                    if j < active:
                        row, moving, less = slopes[d], dx[j], decay[j]
                        for p in range(count):
                            moving[p] = row[p] + (moving[p] - row[p]) * less
                        if mine >= 0:
                            dx[j, mine] += away * decay[j] * h / lag[j]
                elif d == Driver.SQUARE:
                    x[j] = (y / scale_nm) ** 2
                    if j < active:
                        for p in range(count):
                            dx[j, p] = 2.0 * y * dy[p] / (scale_nm * scale_nm)
                else:
                    of_torque = d == Driver.TORQUE_PLAY
                    now = y / scale_nm if of_torque else width[k]
                    away = now - x[j]
                    if abs(away) > lag[j]:
                        side = 1.0 if away > 0.0 else -1.0
                        x[j] = now - side * lag[j]
                        if j < active:
                            for p in range(count):
                                dx[j, p] = dy[p] * small if of_torque else 0.0
                            if mine >= 0:
                                dx[j, mine] -= side * lag[j]
        pull = k2 * (a - y)
        torque[k + 1], rate[k + 1] = y, pull
        torque_row, rate_row = torques[k + 1], rates[k + 1]
        for p in range(count):
            torque_row[p] = dy[p]
            rate_row[p] = k2 * (da[p] - dy[p]) + pull * (lag_second[p] + by_second[p])
        if used[Place.TORQUE] or used[Place.FACTOR]:
            z[Place.TORQUE], z[Place.FACTOR] = 0.0, 0.0
            dz[Place.TORQUE], dz[Place.FACTOR] = 0.0, 0.0
            for j in range(terms):
                q = places[j]
                if q >= Place.TORQUE:
                    z[q] += sizes[j] * x[j]
                    if j < active and sizes[j] != 0.0:
                        row, moving, much = dz[q], dx[j], sizes[j]
                        for p in range(count):
                            row[p] += much * moving[p]
                    if own[j, 0] >= 0:
                        dz[q, own[j, 0]] += x[j]
            bend = LARGEST * np.tanh(z[Place.FACTOR] / LARGEST)
            factor, less = np.exp(bend), 1.0 - (bend / LARGEST) ** 2
            torque[k + 1] = factor * y + scale_nm * z[Place.TORQUE]
            rate[k + 1] *= factor
            bent, added = dz[Place.FACTOR], dz[Place.TORQUE]
            for p in range(count):
                torque_row[p] = factor * (dy[p] + y * less * bent[p]) + scale_nm * added[p]
                rate_row[p] = factor * rate_row[p] + rate[k + 1] * less * bent[p]
    return torque, rate, torques.T, rates.T
