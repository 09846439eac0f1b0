"""One short experiment, whatever wire carries it, identifies the same parameters."""

from __future__ import annotations

from collections.abc import Callable
from importlib import resources

import pytest

from hil_sim.device.server import TCP, VALVES, WIRES
from protocols.files import library
from protocols.files.plan import resolve
from rig.runs.rigs import load_rig
from tests.cli.bench import SHORT
from tests.studies.wires.agreement import WireResult, identified, over_wire
from tests.studies.wires.in_step import run_in_step

RATE = 100  # [Hz]
Experiment = Callable[[str], WireResult]


@pytest.fixture(scope="module")
def experiment(tmp_path_factory: pytest.TempPathFactory) -> Experiment:
    place = tmp_path_factory.mktemp("wires")
    text = (resources.files("rig") / "shipped" / "shinshu-2dof.yaml").read_text("utf-8")
    rig_file, protocol = place / "slow.yaml", place / "short.yaml"
    rig_file.write_text(text.replace("sample_rate: 1 kHz", f"sample_rate: {RATE} Hz"), "utf-8")
    protocol.write_text(SHORT, "utf-8")
    rig = load_rig(str(rig_file))
    plan = resolve(library.load(str(protocol), {}), rig)

    def over(wire: str) -> WireResult:
        folder = place / wire
        if wire == VALVES:
            run_in_step(plan, rig, 3, folder)
        else:
            over_wire(plan, rig, wire, 3, folder, str(rig_file))
        return WireResult(wire, identified(folder), 0.0)

    return over


@pytest.fixture(scope="module")
def by_tcp(experiment: Experiment) -> WireResult:
    return experiment(TCP)


@pytest.mark.parametrize(
    "wire",
    [
        pytest.param(wire, marks=[pytest.mark.slow] * (wire != "serial"))
        for wire in WIRES
        if wire != TCP
    ],
)
def test_a_wire_changes_no_parameter(wire: str, experiment: Experiment, by_tcp: WireResult) -> None:
    found = experiment(wire)
    if wire != VALVES:  # by these what is hardly determined may stay undetermined
        assert found.parameters.keys() == by_tcp.parameters.keys()
    assert {"Fv2", "b", "C_pp_2", "C_mm_2"} <= found.parameters.keys()
    name, share = found.apart(by_tcp)
    assert share < 1.0, name
