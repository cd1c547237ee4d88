"""Muscles of other physics are physical, are no static curve before linear dynamics, and can be played."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from stimrig.hardware_sim import patients
from stimrig.hardware_sim.__main__ import main
from stimrig.hardware_sim.errors import PatientError
from stimrig.hardware_sim.factory import make_devices
from stimrig.hardware_sim.hidden.chain import Chain
from stimrig.hardware_sim.hidden.mechanism import DRIVEN_BY, ENTERS
from stimrig.hardware_sim.hidden.other_physics import (
    OPEN,
    RECRUITMENT,
    SETS,
    PhysicsMuscle,
    draw_muscle,
    make_muscle,
    parameters,
)
from stimrig.hardware_sim.offline import simulate
from stimrig.hardware_sim.physics_records import record_of_physics
from stimrig.hardware_sim.settings import Settings

RATE_HZ, HELD = 1600, 40
"""Steps a second, and those of a pulse's period."""
DRAWN = [(kinds, name) for kinds in SETS for name in SETS[kinds]]

Answer = Callable[[np.ndarray], np.ndarray]


def drawn(kinds: str, name: str, round_: int = 0) -> PhysicsMuscle:
    return draw_muscle(kinds, list(SETS[kinds]).index(name) + round_ * len(SETS[kinds]))


def answer_of(muscle: PhysicsMuscle) -> Answer:
    """Torque of the rested muscle at 1600 Hz to widths at 40 pulses/s."""

    def answer(widths_us: np.ndarray) -> np.ndarray:
        chain = Chain(muscle.stages(), muscle.base.largest_nm, 1.0 / RATE_HZ)
        held, still = np.repeat(widths_us, HELD), np.zeros(widths_us.size * HELD)
        pulse = still.copy()
        pulse[::HELD] = widths_us > 0.0
        return chain.run(held, pulse, still, still)

    return answer


def departure(muscle: PhysicsMuscle) -> float:
    """How far the muscle is from every static curve before linear dynamics, over its largest torque.

    Of those the answer to two trains is the sum of the answers to each, and another width gives the same shape.
    """
    answer, top_us = answer_of(muscle), muscle.base.largest_width_us
    first, second = np.zeros(200), np.zeros(200)
    first[:60], second[60:120] = top_us, top_us
    alone, both = answer(first), answer(first + second)
    apart = np.max(np.abs(both - alone - answer(second)))
    weaker = answer(np.where(first > 0.0, muscle.base.rise_us()[0] + 0.4 * np.ptp(muscle.base.rise_us()), 0.0))
    share = weaker @ alone / (alone @ alone)
    return max(apart, np.max(np.abs(weaker - share * alone))) / np.max(both)


@pytest.mark.parametrize("round_", range(4))
@pytest.mark.parametrize(("kinds", "name"), DRAWN)
def test_a_muscle_rests_rises_and_decays(kinds: str, name: str, round_: int) -> None:
    muscle = drawn(kinds, name, round_)
    answer, rest, train = answer_of(muscle), np.zeros(80), np.full(120, float(muscle.base.largest_width_us))
    torque = answer(np.concatenate([rest, train, np.zeros(600)]))
    assert not torque[: 80 * HELD].any()
    assert 1.79 < np.max(torque) < 9.01
    assert np.argmax(torque) < 205 * HELD
    assert np.max(np.abs(torque[-10 * HELD :])) < 0.2 * np.max(torque)
    assert not answer(rest).any()


@pytest.mark.parametrize(("kinds", "name"), DRAWN)
def test_any_widths_are_borne(kinds: str, name: str) -> None:
    rng = np.random.default_rng(1)
    widths_us = np.concatenate(
        [rng.choice([0.0, 1.0, 4095.0, 26000.0, *rng.uniform(0.0, 511.0, 8)], 800), np.zeros(80)]
    )
    muscle = drawn(kinds, name)
    torque = answer_of(muscle)(widths_us)
    assert np.isfinite(torque).all()
    assert np.max(np.abs(torque)) < 20.0
    assert np.abs(torque[-1]) < 0.25 * np.max(torque)
    assert np.array_equal(torque, answer_of(drawn(kinds, name))(widths_us))


@pytest.mark.parametrize(("kinds", "name"), DRAWN)
def test_no_muscle_is_a_static_curve_before_linear_dynamics(kinds: str, name: str) -> None:
    assert np.median([departure(drawn(kinds, name, round_)) for round_ in range(16)]) > 0.05


def test_the_oracle_sees_nothing_in_a_plain_muscle() -> None:
    assert max(departure(draw_muscle("plain", seed)) for seed in range(4)) < 1e-3


@pytest.mark.parametrize(("kinds", "name"), DRAWN)
def test_right_answers_are_few_words_of_the_vocabulary(kinds: str, name: str) -> None:
    truth = record_of_physics(kinds, list(SETS[kinds]).index(name))["truth"]
    assert truth["kind"] == name
    assert 1 <= len(truth["enters"]) <= 3 and set(truth["enters"]) <= set(ENTERS)
    assert 1 <= len(truth["driven_by"]) <= 3 and set(truth["driven_by"]) <= set(DRIVEN_BY)


def test_a_plateau_outlasts_wide_pulses_and_no_narrow_ones() -> None:
    def left(width_us: float) -> float:
        torque = answer_of(make_muscle("central_plateau", {}))(np.repeat([width_us, 0.0], [200, 80]))
        return torque[240 * HELD] / torque[200 * HELD - 1]

    assert left(300.0) > 0.1 > 0.01 > left(170.0)


def test_torque_moves_the_electrode_off_the_nerve() -> None:
    torque = answer_of(make_muscle("moving_electrode", {}))(np.full(160, 200.0))
    assert np.max(torque) > 1.1 * torque[-1]
    still = answer_of(make_muscle("moving_electrode", {"moves": 0.3}))(np.full(160, 200.0))
    assert still[-1] > 1.1 * torque[-1]


def test_friction_keeps_torque_back_on_the_way_up_and_down() -> None:
    up = np.linspace(0.0, 300.0, 200)
    rising, falling = np.split(answer_of(make_muscle("dry_cushion", {}))(np.concatenate([up, up[::-1]])), 2)
    late = np.interp(190.0, np.repeat(up, HELD), rising), np.interp(190.0, np.repeat(up, HELD), falling[::-1])
    assert late[1] > late[0] + 2.0 * 0.05 * 5.0


class TestPlayed:
    def test_their_names_are_known_without_compiling(self) -> None:
        assert tuple(OPEN) == patients.OTHER_PHYSICS
        assert not set(OPEN) & set(SETS["sealed"])

    @pytest.mark.parametrize("name", [*patients.OTHER_PHYSICS, "sealed:1", "places:1", "plain:0"])
    def test_the_cell_measures_a_contraction(self, name: str) -> None:
        devices = make_devices(Settings(patient=name, noise_nm=0.0))
        read_nm: list[float] = []
        devices.load_cell.torque_hooks.append(lambda nm, _: read_nm.append(nm) or nm)
        for k in range(40):
            at_s = 0.5 + 0.025 * k + 0.0004
            devices.advance(at_s)
            points = [(500, 20.0), (500, -20.0)]
            assert devices.electrodes.fire(at_s, points, (0, 0), "test")
        devices.advance(6.0)
        assert not np.any(read_nm[: RATE_HZ // 2])
        assert 1.0 < np.max(read_nm) < 10.0
        assert abs(read_nm[-1]) < 0.25 * np.max(read_nm)

    @pytest.mark.parametrize(("kinds", "seed"), [("physics", 1), ("places", 2)])
    def test_set_and_seed_name_the_muscle_of_that_record(self, kinds: str, seed: int) -> None:
        unseen = record_of_physics(kinds, seed)["unseen"]
        widths_us = unseen["pulse_width_us"][::10]
        times_s = 0.025 * np.arange(widths_us.size)
        torque = simulate(patients.make(f"{kinds}:{seed}"), times_s, widths_us, 20.0, RATE_HZ, widths_us.size * 0.025)
        np.testing.assert_allclose(torque[::4], unseen["torque_nm"], atol=1e-6)

    @pytest.mark.parametrize("name", ["ding", "ding_fatigue", "two_buffers"])
    def test_a_pulse_between_two_steps_recruits_as_one_at_a_step(self, name: str) -> None:
        widths_us = np.full(20, 300.0)
        at_step, between = (
            simulate(patients.make(name), 0.1 + 0.025 * np.arange(20) + late_s, widths_us, 20.0, RATE_HZ, 0.8)
            for late_s in (0.0, 0.0005)
        )
        np.testing.assert_allclose(between, at_step, atol=0.03 * np.max(at_step))

    @pytest.mark.parametrize("name", patients.OTHER_PHYSICS)
    def test_its_draws_are_its_parameters(self, name: str, tmp_path: Path) -> None:
        known = parameters(name)
        assert all(low <= usual <= high for low, high, usual in known.values())
        key, (low, high, _) = list(known.items())[len(RECRUITMENT)]
        path = tmp_path / "patient.toml"
        widths_us = np.repeat([300.0, 0.0, 200.0, 0.0], 40)
        torque = []
        for value in (low, high):
            path.write_text(f'patient = "{name}"\n[parameters]\nlargest_nm = 3.0\n{key} = {value}\n')
            times_s = 0.025 * np.arange(widths_us.size)
            torque.append(simulate(patients.from_file(path), times_s, widths_us, 20.0, RATE_HZ, 4.0))
        assert all(2.5 < np.max(one) < 4.0 for one in torque)
        assert np.max(np.abs(torque[0] - torque[1])) > 0.02

    @pytest.mark.parametrize(
        ("text", "told"),
        [
            (
                'patient = "ding"\n[parameters]\ntau = 1',
                "no parameter 'tau'; it has largest_nm, .*calcium_s, .*doublet",
            ),
            ('patient = "ding"\n[parameters]\ncalcium_s = 1', "'calcium_s' must be from 0.011 to 0.03, not 1"),
            ('patient = "ding"\n[parameters]\ncalcium_s = nan', "finite number"),
            ('patient = "kept_a"', "neither a file nor SET:SEED nor one of calcium, .*, swinging_splint$"),
            ('patient = "places:x"', "neither a file nor SET:SEED"),
            ('patient = "sealed:1"\n[parameters]\nlargest_nm = 3', "has no parameters; its seed decides them"),
        ],
    )
    def test_what_is_wrong_is_told_in_a_line(self, tmp_path: Path, text: str, told: str) -> None:
        path = tmp_path / "patient.toml"
        path.write_text(text)
        with pytest.raises(PatientError, match=told) as caught:
            patients.from_file(path)
        assert "\n" not in str(caught.value)

    def test_the_page_lists_them(self) -> None:
        page = (Path(__file__).parents[2] / "docs" / "emulated-arm.md").read_text("utf-8")
        assert sorted(re.findall(r"^\| `(\w+)` \| (?:in|at|among)", page, re.M)) == sorted(patients.OTHER_PHYSICS)

    def test_the_help_names_them(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["--help"]) == 0
        text = " ".join(capsys.readouterr().out.split())
        assert ", ".join(patients.NAMES) in text
        assert "kept" not in text
