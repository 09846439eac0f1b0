"""Compile what many tests need, once, before the workers start: each would compile its own.

    python -m tests.warm_up plant | model | benches

In a checkout that has been tested before, everything is read from numba's caches at once.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).parents[1]


def compile_all(cache: Path) -> None:
    """Compile every part in a process of its own, side by side; equations go into `cache`."""
    environment = {**os.environ, "BRAMAH_CACHE": str(cache)}
    running = [
        subprocess.Popen([sys.executable, "-m", __name__, part], cwd=ROOT, env=environment)
        for part in PARTS
    ]
    codes = [process.wait() for process in running]
    assert not any(codes), f"the warm-up failed: {dict(zip(PARTS, codes, strict=True))}"


def compile_plant() -> None:
    """Compile the simulated bench."""
    from hil_sim.plant.plant import Plant
    from hil_sim.scenario.file import Scenario
    from rig.runs.rigs import load_rig

    Plant(load_rig("shinshu-2dof"), Scenario(), 0)


def compile_model() -> None:
    """Compile the tests' small bench, the model's equations and every term's kernel."""
    from analysis.identify.identify import identify
    from analysis.simulation.interpreted import compiled_rates
    from analysis.simulation.validate import validate
    from analysis.terms import known
    from analysis.terms.base import Kernel
    from tests.analysis import small_bench

    excitations = small_bench.default_excitations(1, 0.025)
    run = small_bench.experiment(small_bench.shinshu(), excitations, repeats=1, seed=1)
    validate(identify([run]).model, [run])
    compiled_rates()
    for module in {sys.modules[term.__module__] for term in known().values()}:
        for value in vars(module).values():
            if isinstance(value, Kernel):
                assert value.address


def compile_benches() -> None:
    """Compile the benches that tests simulate without the product's plant."""
    from tests.analysis.effects import one_joint
    from tests.analysis.small_bench import shinshu
    from tests.analysis.trace import foreign_bench
    from tests.studies.foreign import bench, cases

    wave = one_joint.excitation(0.03, 1)
    one_joint.channels(shinshu(), one_joint.RIGHT, wave, 0.1)
    foreign_bench.channels(shinshu(), foreign_bench.Hidden(), wave, 0.1)
    bench.channels(cases.case_of(0, kind=cases.NONE).bench, "step1", 1, 1.0)


PARTS: Final[dict[str, Callable[[], None]]] = {
    "plant": compile_plant,
    "model": compile_model,
    "benches": compile_benches,
}

if __name__ == "__main__":
    PARTS[sys.argv[1]]()
