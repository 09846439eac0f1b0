"""Valves of CiA 408 and their host in one time, held in step: a run as fast as the computer is.

The host of such valves is their sample clock. On a busy computer a run in real time measures the
computer; here the frames go over the same bus, and nobody is late.
"""

from __future__ import annotations

from pathlib import Path

from hil_sim.plant.plant import Plant
from hil_sim.scenario.file import Scenario
from protocols.engine import engine
from protocols.files.plan import Plan
from rig.bench.session import Bench
from rig.cli.simulated.simulator import VALVES_RATE
from rig.model.rig import Rig
from rig.runs.recorder import Recorder
from tests.drivers.valve_bus import HeldValves


def run_in_step(plan: Plan, rig: Rig, seed: int, folder: Path) -> None:
    """Run a plan on simulated valves into a folder; raises what ends it."""
    plant_rig = rig.model_copy(update={"sample_rate": VALVES_RATE})
    with HeldValves(plant_rig, Plant(plant_rig, Scenario(), seed)) as held:
        reached = rig.model_copy(update={"wire": held.wire(rig)})
        recorder = Recorder(folder, reached, protocol=plan.protocol.model_dump(mode="json"))
        with Bench(
            reached, held.driver(reached), recorder, clock=held.clock, signals=False
        ) as bench:
            engine.run(plan, reached, bench)
