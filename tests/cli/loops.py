"""Loops without a wire: the bench is a plant of this process, everything else is as it is run."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from hil_sim.scenario.file import Scenario, parse_scenario
from protocols.engine import engine
from protocols.files import library
from protocols.files.plan import Overrides, resolve
from rig.cli.execution.experiment_loop import Loop, LoopRequest
from rig.model.records import Run
from tests.studies.direct_bench import DirectBench

SINE = """
name: sine
description: The arm moved by the paper's sine, the boom locked
joints: 2
steps:
  - name: step1
    lock: [{joint: 1, at: closed, piston: 0 mm, tolerance: 5 mm}]
    excite:
      - joint: 2
        signal: {kind: sine, frequency: 1 Hz, amplitude: 0.8 V}
        centring: {mode: open-loop, drift: 4 mm, offset: 4 mm, tries: 6}
    repeats: 3
    duration: 6 s
    warm_up: 2
"""
WAVES = """
name: waves
description: The arm moved by a multisine, the boom locked
joints: 2
steps:
  - name: step1
    lock: [{joint: 1, at: closed, piston: 0 mm, tolerance: 5 mm}]
    excite:
      - joint: 2
        signal: {kind: multisine, base_frequency: 0.2 Hz, f_min: 0.4 Hz, f_max: 9.5 Hz,
                 amplitude: 0.3 V, seed: 1}
        centring: {mode: open-loop, drift: 4 mm, offset: 4 mm, tries: 6}
    repeats: 3
    warm_up: 1
"""


class Inside(Loop):
    """A loop on a plant of this process that hides a scenario and lives through all its runs.

    Its oil keeps its temperature: what that does to b is no part of these stories.
    """

    def __init__(self, request: LoopRequest, hidden: Scenario) -> None:
        self.said: list[str] = []
        super().__init__(request, self.said.append)
        steady = self.rig.oil.model_copy(update={"temperature_band": 0.0})
        self.rig = self.rig.model_copy(update={"oil": steady})
        self._bench = DirectBench(self.rig, hidden, 41)

    def _run(self, name: str, protocol: str, sizes: Overrides) -> Run:
        before = len(self._bench.records)
        engine.run(resolve(library.load(protocol), self.rig, sizes), self.rig, self._bench)
        return Run(self.rig, tuple(self._bench.records[before:]), name)


def looped(
    out: Path, protocol: str, effects: str, *, rounds: int = 2, until_visible: bool = False,
    ask: Callable[[Mapping[str, Any]], bool] = lambda experiment: True,
) -> Inside:  # fmt: skip
    """Close a loop on a bench that hides `effects`, and return it as it ended."""
    path = out / "first.yaml"
    path.write_text(protocol)
    request = LoopRequest(
        "shinshu-2dof", out, protocol=str(path), rounds=rounds, until_visible=until_visible, ask=ask
    )
    experiments = Inside(request, parse_scenario(f"effects: [{effects}]", "hidden"))
    experiments.run()
    return experiments
