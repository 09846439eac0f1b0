"""A disturbance that begins with the record keeps its phase wherever a simulation begins."""

from __future__ import annotations

import numpy as np

from analysis.effects.base import Effect
from analysis.signals.conditioning import condition
from analysis.signals.filters import channel_filter
from analysis.simulation.simulate import State, drive_of, simulate
from analysis.terms import make
from rig.model.rig import Rig
from tests.analysis.effects import one_joint as bench
from tests.analysis.effects.fitting import model_of
from tests.analysis.small_bench import TRUTH


def test_a_simulation_from_the_middle_of_a_record_meets_the_disturbance_as_it_is_there(
    rig: Rig,
) -> None:
    effect = make("periodic_disturbance", "joint 2")
    assert isinstance(effect, Effect)
    values = TRUTH | {"T_sin_2": 6.0, "T_cos_2": -2.0}
    model = model_of(rig, effect, values, (3.3,))
    clean = bench.channels(rig, bench.RIGHT, bench.excitation(0.03, 2), 2.0)
    record = bench.record(rig, clean, "free_r1", 0, noise=0.0)
    drive = drive_of(condition(rig, record, channel_filter(1000.0), np.array([0.0, np.inf])))
    q, qd, rest = drive.q[0], np.zeros(2), np.full(2, 3.5e6)
    whole = simulate(model, drive, State(q, qd, rest, rest))
    k = 777
    here = State(whole.q[k], whole.qd[k], whole.p_cap[k], whole.p_rod[k])
    part = simulate(model, drive, here, k)
    assert np.abs(part.piston[:, 1] - whole.piston[k:, 1]).max() < 5e-6
    still = model_of(rig, effect, TRUTH | {"T_sin_2": 0.0, "T_cos_2": 0.0}, (3.3,))
    assert np.abs(simulate(still, drive, here, k).piston[:, 1] - part.piston[:, 1]).max() > 1e-4
