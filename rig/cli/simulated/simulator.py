"""Build a simulated bench's plant, compile it, serve it until a signal (`sim`)."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

from drivers.modbus_tcp import TcpSettings
from hil_sim.device.lifetime import EndpointError, ParentProcess
from hil_sim.device.server import CAN, SLCAN, TCP, VALVES, WIRES, serve, warm_up
from hil_sim.faults import CLASSES
from hil_sim.faults.wire import WireFault
from hil_sim.link.link import FaultyLink
from hil_sim.link.wires import faulty_link
from hil_sim.plant.faulty import FaultyPlant
from hil_sim.plant.plant import Plant
from hil_sim.scenario.file import Scenario, load_shipped, parse_scenario, shipped_scenarios
from hil_sim.scenario.random_draw import RANDOM, draw
from rig.cli.errors import WorkError
from rig.cli.simulated.simulated_bench import write_truth
from rig.model.parse import InputError
from rig.model.rig import Rig
from rig.runs.files import read_text
from rig.runs.rigs import load_bench

NAMED_FAULT_SHARE: Final = 0.01  # share of the frames that a fault given by its name affects
# Rate of the plant behind valves that the host samples at any time [Hz].
VALVES_RATE: Final = 1000.0


def _scenario(name: str | None, rig: Rig, seed: int) -> Scenario:
    if name is None:
        return Scenario()
    if name == RANDOM:
        return draw(rig, seed)
    if name in shipped_scenarios():
        return load_shipped(name)
    return _scenario_file("--scenario", name, (RANDOM, *shipped_scenarios()))


def _scenario_file(option: str, name: str, known: Iterable[str]) -> Scenario:
    """Return the scenario of the file `name`; raises InputError for a name that is not `known`."""
    path = Path(name)
    if not path.suffix and not path.exists():
        raise InputError(f"{option} {name}: expected a file, or one of: {' '.join(sorted(known))}")
    return parse_scenario(read_text(path, "a scenario"), name)


def wire_faults(name: str | None) -> tuple[WireFault, ...]:
    """Return the faults of the wire of a file or a name; raises InputError for others."""
    if name is None:
        return ()
    known = {kind.fault_name(): kind for kind in CLASSES if issubclass(kind, WireFault)}
    if name in known:
        return (known[name].model_validate({"name": name, "probability": NAMED_FAULT_SHARE}),)
    scenario = _scenario_file("--wire-faults", name, known)
    if scenario != Scenario(description=scenario.description, faults=scenario.wire_faults):
        raise InputError(
            f"--wire-faults {name}: expected faults of the wire only ({' '.join(sorted(known))}); "
            "give everything else as --scenario"
        )
    return scenario.wire_faults


def serve_bench(
    rig_name: str,
    wire: str,
    seed: int,
    scenario_name: str | None,
    faults_name: str | None,
    port: int | None,
    real_time: bool,
    truth: Path | None,
    parent: int | None,
) -> None:
    """Serve a simulated bench; raises InputError for bad files, WorkError for a busy port.

    `scenario_name`: a file of hidden effects, the name of a shipped one, or ``random``, drawn by
    `seed`. `faults_name`: a file of faults, or the name of a fault of the wire that then affects
    one frame in a hundred. `truth`: a file for the true parameters and hidden effects.
    `parent`: the number of the process that the bench ends with.
    """
    process = None if parent is None else ParentProcess(parent)
    if wire not in WIRES:
        raise InputError(f"--wire {wire}: expected one of: {' '.join(WIRES)}")
    rig = load_bench(rig_name)
    if wire == VALVES:
        # The rig's rate is the host's; the valves sample when SYNC arrives, not at fixed ticks.
        rig = rig.model_copy(update={"sample_rate": max(VALVES_RATE, rig.sample_rate)})
    scenario = _scenario(scenario_name, rig, seed)
    faults = (*scenario.wire_faults, *wire_faults(faults_name))
    plant = FaultyPlant(rig, scenario, seed)
    # Compiles before the first request, on a second plant so that the served one starts at rest.
    warm_up(rig, Plant(rig, scenario, seed))
    write_truth(truth, plant.plant.truth(), scenario.model_dump(mode="json"))
    address = _address(wire, rig, port)
    links: list[FaultyLink] = []

    def ready(endpoint: str) -> None:
        if faults:
            links.append(
                faulty_link(
                    endpoint,
                    faults,
                    seed=seed,
                    seconds=lambda: plant.tick / rig.sample_rate,
                    port=address.get("port", 0),
                )
            )
            endpoint = links[0].endpoint
        print(endpoint, flush=True)  # a script that starts the bench reads this line

    try:
        serve(
            rig,
            plant,
            **(address | {"port": 0} if faults else address),
            wire=wire,
            realtime=real_time,
            on_ready=ready,
            parent=process,
            faults=scenario.device_faults,
        )
    except EndpointError as error:
        raise WorkError(str(error)) from error
    finally:
        for link in links:
            link.close()


def _address(wire: str, rig: Rig, port: int | None) -> dict[str, Any]:
    """Return the wire's keywords for `serve`."""
    if wire == VALVES:
        return {"port": port or 0}
    if wire in (CAN, SLCAN):
        return _bus(rig, port)
    tcp = TcpSettings.of(rig.wire) if rig.wire.kind == TCP else TcpSettings()
    return {"host": tcp.host, "port": tcp.port if port is None else port}


def _bus(rig: Rig, port: int | None) -> dict[str, Any]:
    from drivers.can_port import SOCKETCAND, BusPlace
    from drivers.can_stream import CanSettings, can_layout

    if rig.wire.kind != CAN:
        return {"port": port or 0}
    settings = CanSettings.of(rig.wire)
    bus = BusPlace.of(settings.bus)
    address = {"host": bus.host, "port": bus.port} if bus.interface == SOCKETCAND else {}
    if port is not None:
        address["port"] = port
    return {**address, "layout": can_layout(settings, rig), "bitrate": settings.bitrate}
