"""The `sim` verb's work: build the plant, warm it up, serve it until told to end."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drivers.modbus_tcp import TcpSettings
from hil_sim.device.server import CAN, SLCAN, TCP, WIRES, EndpointError, serve, warm_up
from hil_sim.plant.faulty import FaultyPlant
from hil_sim.plant.plant import Plant
from hil_sim.scenario.file import Scenario, load_shipped, parse_scenario, shipped_scenarios
from hil_sim.scenario.random_draw import RANDOM, draw
from rig.cli.errors import WorkError
from rig.cli.truth_file import write_truth
from rig.model.parse import InputError
from rig.model.rig import Rig
from rig.runs.files import read_text
from rig.runs.rigs import load_bench


@dataclass(frozen=True)
class Served:
    """What to serve and where.

    `scenario` is a file of hidden effects, a shipped one's name, or ``random``: drawn here, by
    `seed`; `truth` is a file for the plant's true parameters and what it hides.
    """

    rig: str
    seed: int = 0
    scenario: str | None = None
    port: int | None = None
    real_time: bool = False
    truth: Path | None = None
    parent: int | None = None
    wire: str = TCP


def _endpoint_first(endpoint: str) -> None:
    # A script that starts the bench reads this line to know where it is.
    print(endpoint, flush=True)


def hidden(what: Served, rig: Rig) -> Scenario:
    """Return the scenario that a bench hides; raises InputError for a bad file."""
    if what.scenario is None:
        return Scenario()
    if what.scenario == RANDOM:
        return draw(rig, what.seed)
    if what.scenario in shipped_scenarios():
        return load_shipped(what.scenario)
    return parse_scenario(read_text(Path(what.scenario), "a scenario"), what.scenario)


def serve_bench(what: Served) -> None:
    """Serve a simulated bench; raises InputError for bad files, WorkError for a busy port."""
    if what.wire not in WIRES:
        raise InputError(f"--wire {what.wire}: expected one of: {' '.join(WIRES)}")
    rig = load_bench(what.rig)
    scenario = hidden(what, rig)
    plant = FaultyPlant(rig, scenario, what.seed)
    # Compiled before anybody waits for an answer, on a spare so that this one starts at rest.
    warm_up(rig, Plant(rig, scenario, what.seed))
    write_truth(what.truth, plant.plant.truth(), scenario.model_dump(mode="json"))
    try:
        serve(
            rig,
            plant,
            **_place(what, rig),
            wire=what.wire,
            realtime=what.real_time,
            on_ready=_endpoint_first,
            parent=what.parent,
        )
    except EndpointError as error:
        raise WorkError(str(error)) from error


def _place(what: Served, rig: Rig) -> dict[str, Any]:
    """Return where to serve, as keywords of `serve`; raises InputError for a wire it cannot be."""
    if what.wire in (CAN, SLCAN):
        return _bus(what, rig)
    tcp = TcpSettings.of(rig.wire) if rig.wire.kind == TCP else TcpSettings()
    return {"host": tcp.host, "port": tcp.port if what.port is None else what.port}


def _bus(what: Served, rig: Rig) -> dict[str, Any]:
    from drivers.can_port import SOCKETCAND, BusPlace
    from drivers.can_stream import CanSettings, can_layout

    if rig.wire.kind != CAN:
        return {"port": what.port or 0}
    at = CanSettings.of(rig.wire)
    place = BusPlace.of(at.bus)
    here = {"host": place.host, "port": place.port} if place.interface == SOCKETCAND else {}
    if what.port is not None:
        here["port"] = what.port
    return {**here, "layout": can_layout(at, rig), "bitrate": at.bitrate}
