"""Held-out records, not the energy left, say whether dry friction has a level by direction."""

from __future__ import annotations

import pytest

from analysis.trace.judge import readings
from rig.model.rig import Rig
from tests.analysis.trace.foreign_bench import Hidden, pair_of_runs
from tests.analysis.trace.gate_cases import searched


def test_two_levels_that_energy_takes_for_one_are_asymmetric_friction(rig: Rig) -> None:
    """21 and 38 N, one repeat, eight times the noise: both laws leave about equally little."""
    runs = pair_of_runs(rig, Hidden(21.0, 38.0), repeats=1, noise=8.0)
    s = searched(rig, *runs, "coulomb_friction", "asymmetric_friction")
    assert [u.term.name for u in s.winner.effects] == ["coulomb_friction"]
    settled = readings.best_readings(s.hypotheses, s.winner, s.holdout_data)
    assert [u.term.name for u in settled.effects] == ["asymmetric_friction"]
    assert settled.fit.beta["F_ext_2"] == pytest.approx(21.0, rel=0.2)
    assert settled.fit.beta["F_ret_2"] == pytest.approx(38.0, rel=0.2)


def test_one_level_in_the_same_noise_stays_coulomb_friction(rig: Rig) -> None:
    runs = pair_of_runs(rig, Hidden(30.0, 30.0), repeats=1, noise=8.0)
    s = searched(rig, *runs, "coulomb_friction", "asymmetric_friction")
    settled = readings.best_readings(s.hypotheses, s.winner, s.holdout_data)
    assert [u.term.name for u in settled.effects] == ["coulomb_friction"]
