"""Runs of shipped protocols on simulated benches, sound and aged, each under the bench's guard."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from drivers.in_process import InProcessDriver
from hil_sim.plant.faulty import FaultyPlant
from hil_sim.scenario.file import Scenario, parse_scenario
from protocols.design.generate import generate
from protocols.engine import engine
from protocols.engine.states import ProtocolAborted
from protocols.files.library import load
from protocols.files.plan import Overrides, resolve
from protocols.files.schema import Protocol
from rig.bench.latch import BenchState
from rig.bench.session import Bench
from rig.cli.proof.step_planning import predictor
from rig.model.parts import Wire
from rig.model.rig import Rig
from rig.model.trips import SafetyTrip
from rig.runs.rigs import load_rig
from tests.studies.effects.simulated import EXAMPLES

SHIPPED = ("lock-and-excite", "lock-and-excite-multisine", "validate")
SEED_BENCH = "shinshu-2dof"
OTHERS = ("boom-1dof", "digger-3dof")


@dataclass(frozen=True)
class Case:
    """One run: rig, protocol and what the bench hides (empty: nothing)."""

    rig: Rig
    protocol: Protocol
    hidden: str

    @property
    def name(self) -> str:
        """What the table calls it."""
        return f"{self.rig.name}, {self.protocol.name}, {self.hidden or 'sound'}"

    @property
    def scenario(self) -> Scenario:
        """What the simulated bench is told."""
        said = next((said for name, _, said, _ in EXAMPLES if name == self.hidden), None)
        if said is None:
            return Scenario()
        return parse_scenario(f"effects: [{{name: {self.hidden}, {said}}}]", self.hidden)


def cases() -> Iterator[Case]:
    """Yield every shipped protocol on every rig that can be simulated, sound and with effects.

    Rigs of another number of joints than the shipped protocols' run the protocol that `bramah plan`
    generates for them.
    """
    rig = load_rig(SEED_BENCH)
    for protocol in map(load, SHIPPED):
        for hidden in ("", *dict.fromkeys(name for name, *_ in EXAMPLES)):
            yield Case(rig, protocol, hidden)
    for name in OTHERS:
        other = load_rig(name)
        yield Case(other, generate(other, predictor(), f"plan-{name}").protocol, "")


def alarms(case: Case, seed: int) -> tuple[list[str], str]:
    """Run one case; return the alarms it raised, and how it ended where it did not complete."""
    driver = InProcessDriver(
        Wire(kind="in-process"),
        case.rig,
        make=lambda rig: FaultyPlant(rig, case.scenario, seed),
    )
    plan = resolve(case.protocol, case.rig, Overrides(repeats=1))
    end = ""
    with TemporaryDirectory() as folder:  # a trip here must not latch anybody's bench
        state = BenchState(case.rig.wire, Path(folder))
        bench = Bench(case.rig, driver, signals=False, state=state)
        try:
            with bench:
                engine.run(plan, case.rig, bench)
        except (SafetyTrip, ProtocolAborted) as error:
            end = str(error)
    return [alarm.key for alarm in bench.alarms.alarms], end
