"""Records of the small bench, made once for all tests of the analysis."""

from __future__ import annotations

import numpy as np
import pytest

from rig.model.records import Run
from rig.model.rig import Rig
from tests.analysis import small_bench as bench


@pytest.fixture(scope="session")
def rig() -> Rig:
    return bench.shinshu()


@pytest.fixture(scope="session")
def multisine_run(rig: Rig) -> Run:
    """Three steps, four repeats of 10 s, stated sensor noise."""
    return bench.experiment(rig, bench.default_excitations(1, 0.025), repeats=4, seed=1)


@pytest.fixture(scope="session")
def sine_run(rig: Rig) -> Run:
    """The paper's 1 Hz sine in all steps, four repeats."""
    excitations = {
        step.name: {
            i - 1: bench.Excitation.sine(0.1 if i == 2 else 0.07)
            for i in (1, 2)
            if i not in step.locked
        }
        for step in bench.STEPS
    }
    return bench.experiment(rig, excitations, repeats=4, seed=2)


@pytest.fixture(scope="session")
def both_run(rig: Rig) -> Run:
    """New data: both joints at once, excitations that no identification used."""
    rng = np.random.default_rng(77)
    wave = {0: bench.Excitation.multisine(0.018, rng), 1: bench.Excitation.multisine(0.02, rng)}
    step = bench.Step("both", (), (0.0, 0.0))
    return bench.experiment(rig, {"both": wave}, repeats=1, seed=3, steps=(step,), seconds=6.0)
