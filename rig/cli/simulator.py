"""The `sim` verb's work: build the plant, warm it up, serve it until told to end."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from hil_sim.plant import Plant
from hil_sim.scenario import Scenario, parse_scenario
from hil_sim.server import EndpointError, serve, warm_up
from rig.cli.errors import WorkError
from rig.cli.output import write_json
from rig.services.files import read_text
from rig.services.rigs import load_bench


@dataclass(frozen=True)
class Served:
    """What to serve and where; `truth` is a file for the plant's true parameters."""

    rig: str
    seed: int = 0
    scenario: Path | None = None
    port: int | None = None
    real_time: bool = False
    truth: Path | None = None
    parent: int | None = None


def _endpoint_first(endpoint: str) -> None:
    # A script that starts the bench reads this line to know where it is.
    print(endpoint, flush=True)


def serve_bench(what: Served) -> None:
    """Serve a simulated bench; raises InputError for bad files, WorkError for a busy port."""
    rig = load_bench(what.rig)
    scenario = Scenario()
    if what.scenario is not None:
        scenario = parse_scenario(read_text(what.scenario, "a scenario"), str(what.scenario))
    plant = Plant(rig, scenario, what.seed)
    # Compiled before anybody waits for an answer, on a spare so that this one starts at rest.
    warm_up(rig, Plant(rig, scenario, what.seed))
    write_json(what.truth, plant.truth())
    port = rig.wire.port if what.port is None else what.port
    try:
        serve(
            rig,
            plant,
            host=rig.wire.host,
            port=port,
            realtime=what.real_time,
            on_ready=_endpoint_first,
            parent=what.parent,
        )
    except EndpointError as error:
        raise WorkError(str(error)) from error
