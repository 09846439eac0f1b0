"""What a contact or a lagging spool remembers is known wherever in a record a simulation begins."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from analysis.effects.base import Effect
from analysis.signals.conditioning import condition
from analysis.simulation.simulate import drive_of, hidden_paths, simulate, state_at
from analysis.terms import make
from rig.model.rig import Rig
from tests.analysis.effects import one_joint as bench
from tests.analysis.effects.fitting import model_of
from tests.analysis.small_bench import TRUTH
from tests.variants import every_second

DELTA = bench.SHAPES["presliding"]
CASES = {
    "spool_lag": ({"tau_spool": 6e-3}, {}, (6e-3,)),
    "coulomb_friction": ({"Fc": 60}, {"Fc2": 60}, (DELTA,)),
    "stribeck_friction": ({"Fs": 50}, {"Fs2": 50}, (bench.SHAPES["v_stribeck"], DELTA)),
    "asymmetric_friction": (
        {"F_ext": 70, "F_ret": 40},
        {"F_ext_2": 70, "F_ret_2": 40},
        (DELTA,) * 2,
    ),
    "pressure_dependent_friction": ({"k_friction": 8e-6}, {"k_friction_2": 8e-6}, (DELTA,)),
}


@pytest.mark.parametrize("name", every_second(CASES))
def test_a_run_begun_in_the_midst_of_a_motion_follows_the_other_programs_bench(
    rig: Rig, name: str
) -> None:
    wrong, values, shape = CASES[name]
    clean = bench.channels(rig, bench.Wrong.of(**wrong), bench.excitation(0.03, 1), 3.0)
    signals = condition(rig, bench.record(rig, clean, "step1_r1", 1, noise=0.0))
    effect = make(name, "joint 2")
    assert isinstance(effect, Effect)
    model = model_of(rig, effect, TRUTH | values, shape)
    drive, paths = drive_of(signals), hidden_paths(model, signals)
    length = round(0.1 * rig.sample_rate)
    errors = []
    for first in range(400, 2400, 50):
        start = state_at(signals, first)
        known = replace(start, hidden=paths[first])
        found = [simulate(model, drive, s, first, length).p_cap[:, 1] for s in (known, start)]
        errors.append([np.sum((p - signals.p_cap[first : first + length, 1]) ** 2) for p in found])
    with_memory, without = np.sqrt(np.sum(errors, axis=0))
    assert with_memory < 0.5 * without
