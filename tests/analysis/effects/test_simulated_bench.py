"""Effects in the simulator's own form, found by the catalogue's: size within a tenth.

One step, one repeat of the multisine protocol; `python -m tests.studies effects --study` does all
effects and all steps, with held-out records.
"""

from __future__ import annotations

import pytest

from analysis.effects.base import Effect
from analysis.terms import make
from hil_sim.scenario.file import parse_scenario
from protocols.files.plan import Overrides
from rig.model.rig import Rig
from tests.analysis.effects.fitting import Data, fitted
from tests.studies.direct_bench import simulated_run
from tests.variants import every_second

ONE_STEP = Overrides(repeats=1, steps=("step1",))
CASES = [
    ("coulomb_friction", "joint 2", "where: joint 2, force: 80 N", {"Fc2": 80.0}),
    ("valve_deadband", "joint 2", "where: joint 2, width: 6 mV", {"w_ahead_2": 6e-3}),
    ("internal_leakage", "joint 2", "where: joint 2, conductance: 2e-12 m^3/(s*Pa)",
     {"c_internal_2": 2e-12}),
    ("dead_volume", "joint 2 cap", "where: joint 2 cap, volume: 50 cm^3", {"V_dead_2_cap": 5e-5}),
    ("channel_delay", "joint 2 piston", "channel: piston_2, time: 3 ms", {"delay_piston_2": 3e-3}),
]  # fmt: skip


def records(rig: Rig, scenario: str) -> Data:
    said = parse_scenario(scenario, "test") if scenario else None
    return Data(simulated_run(rig, "lock-and-excite-multisine", 7, said, ONE_STEP)[0])


@pytest.fixture(scope="module")
def floor(rig: Rig) -> dict[str, float]:
    return records(rig, "").solved([]).rms


@pytest.mark.parametrize(
    ("name", "where", "said", "sizes"), every_second(CASES), ids=[c[0] for c in CASES]
)
def test_the_simulators_own_form_is_sized_within_a_tenth(
    rig: Rig, floor: dict[str, float], name: str, where: str, said: str, sizes: dict[str, float]
) -> None:
    data = records(rig, f"effects: [{{name: {name}, {said}}}]")
    effect = make(name, where)
    assert isinstance(effect, Effect)
    before = data.solved([]).rms
    fit = fitted(data, effect, floor)
    assert max(before[row] / floor[row] for row in floor) > 3
    assert max(fit.rms[row] / floor[row] for row in floor) < 2.2
    assert effect.problem(rig, fit.values, fit.shape) == ""
    for parameter, size in sizes.items():
        assert fit.of(effect)[parameter] == pytest.approx(size, rel=0.1)
