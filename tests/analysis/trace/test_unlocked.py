"""A torque in another phase in every record is named by what the repeats differ by."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from analysis.simulation.synthetic import multisine, synthetic_run
from analysis.terms import baseline_of
from analysis.terms.base import Used
from analysis.trace.data.conditioned_record import conditioned_records
from analysis.trace.data.regression_data import regression_data
from analysis.trace.engine import trace
from analysis.trace.judge.unrepeated import unlocked_lines
from analysis.trace.result import EXPLAINED, UNEXPLAINED
from rig.model.records import Run
from rig.model.rig import Rig
from rig.runs.rigs import load_rig
from tests.analysis.carriage import Carriage, moves, record
from tests.studies.machines import electric_plant

AMPLITUDE, FREQUENCY = 3.0, 3.3  # [N], [Hz]


def shaken(
    seed: int, wave: float, repeats: int, force: float, at: tuple[float, ...] = (FREQUENCY,)
) -> Run:
    """Return repeats of a carriage that resists forces [N] of any phase `at` frequencies [Hz]."""
    rig, rng = load_rig("emps"), np.random.default_rng(seed)
    reference = moves(rig.sample_rate, 8.0, 0.05, wave)
    carriage = Carriage(dry=0.0, offset=0.0)
    records = []
    for repeat in range(1, repeats + 1):
        one = record(rig, carriage, reference, rng, "moves", repeat)
        turns = [f * np.asarray(one.time) + rng.uniform() for f in at]
        whole = force / rig.drive_gains[0] * np.sum(np.sin(2 * np.pi * np.array(turns)), axis=0)
        drive = one.channels["drive_1"] + whole
        records.append(replace(one, channels={**one.channels, "drive_1": drive}))
    return Run(rig, tuple(records))


def lines_of(run: Run) -> tuple[tuple[int, float], ...]:
    terms = tuple(map(Used, baseline_of(run.rig)))
    return unlocked_lines(regression_data(run.rig, terms, conditioned_records(run.rig, [run])))


def test_a_force_in_another_phase_in_every_repeat_is_named_with_its_amplitude() -> None:
    result = trace(
        [shaken(1, 0.25, 3, AMPLITUDE)], [shaken(2, 0.31, 1, AMPLITUDE)], look_ahead=False
    )
    assert result.verdict == EXPLAINED
    (effect,) = result.effects
    assert (effect.name, effect.where) == ("periodic_disturbance", "joint 1")
    for name, truth in (("T_amplitude_1", AMPLITUDE), ("frequency_1", FREQUENCY)):
        low, high = effect.parameters[name].ci95
        assert low < truth < high
        assert high - low < 0.1 * truth
    assert result.after["torque_1"] < 1.3 * result.noise_floor["torque_1"]
    assert result.before["torque_1"] > 2.0 * result.noise_floor["torque_1"]
    assert result.unexplained_fraction < 0.05
    assert any("has another phase in each record" in note for note in result.notes)


def test_a_force_that_the_held_out_records_lack_is_refused() -> None:
    result = trace([shaken(1, 0.25, 3, AMPLITUDE)], [shaken(2, 0.31, 1, 0.0)], look_ahead=False)
    assert not result.effects
    assert "periodic_disturbance" in {f.name for f in result.refused}


def test_a_torque_is_named_beside_one_at_another_joint_that_is_refused() -> None:
    """The elbow's torque acts in the training records alone, the shoulder's in all."""
    arm = replace(electric_plant.draw_arm(np.random.default_rng(5)), dry=(1e-9, 1e-9))

    def hummed(seed: int, elbow: float) -> Run:
        rng, rig = np.random.default_rng(seed), load_rig("electric-2dof")
        records = []
        for one in electric_plant.records(rig, arm, rng, repeats=2).records:
            channels = dict(one.channels)
            for joint, amplitude, frequency in ((0, 2.0, 5.3), (1, elbow, 11.1)):
                wave = np.sin(2 * np.pi * (frequency * np.asarray(one.time) + rng.uniform()))
                channels[f"drive_{joint + 1}"] += amplitude / rig.drive_gains[joint] * wave
            records.append(replace(one, channels=channels))
        return Run(rig, tuple(records))

    result = trace([hummed(1, 1.0)], [hummed(2, 0.0)], look_ahead=False)
    (effect,) = result.effects
    assert (effect.name, effect.where) == ("periodic_disturbance", "joint 1")
    assert effect.parameters["T_amplitude_1"].value == pytest.approx(2.0, rel=0.05)
    refused = {(f.name, f.where) for f in result.refused}
    assert ("periodic_disturbance", "joint 2") in refused
    assert result.after["torque_1"] < 0.5 * result.before["torque_1"]


@pytest.mark.slow
def test_forces_at_several_frequencies_get_no_advice_to_excite_more() -> None:
    at = (2.3, 3.7, 5.9, 8.3)
    runs = shaken(1, 0.25, 6, 3 * AMPLITUDE, at), shaken(2, 0.25, 1, 3 * AMPLITUDE, at)
    result = trace([runs[0]], [runs[1]], look_ahead=False)
    assert result.verdict == UNEXPLAINED
    assert any("the training repeats differ" in note for note in result.notes)
    assert not any("as much excitation" in note for note in result.notes)


def test_quiet_repeats_and_a_load_that_scatters_with_the_motion_show_no_force() -> None:
    """Friction that falls from repeat to repeat scatters at the one frequency of the motion."""
    rig, rng = load_rig("emps"), np.random.default_rng(3)
    time = np.arange(round(8.0 * rig.sample_rate)) / rig.sample_rate
    sine = 0.12 + 0.05 * np.sin(2 * np.pi * time)
    warming = [
        record(rig, Carriage(viscous=300.0 - 40.0 * k, dry=0.0), sine, rng, "moves", k)
        for k in (1, 2, 3)
    ]
    assert lines_of(shaken(1, 0.25, 3, 0.0)) == ()
    assert lines_of(Run(rig, tuple(warming))) == ()


def test_the_hum_of_a_pressure_sensor_is_no_torque(rig: Rig) -> None:
    """It shows in the chamber's flow too."""
    wave = multisine(np.random.default_rng(1), rig.sample_rate, 4.0, 9.5)
    quiet = synthetic_run(rig, np.random.default_rng(2), wave, rms=0.025, repeats=3)
    rng = np.random.default_rng(5)
    records = []
    for taken in quiet.records:
        angle = 2 * np.pi * (7.3 * np.asarray(taken.time) + rng.uniform())
        cap = taken.channels["cap_pressure_2"] + 3e4 * np.sin(angle)
        records.append(replace(taken, channels={**taken.channels, "cap_pressure_2": cap}))
    assert lines_of(replace(quiet, records=tuple(records))) == ()
