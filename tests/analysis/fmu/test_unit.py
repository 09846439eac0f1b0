"""A model leaves as a mock-up unit, and another program runs it as Bramah itself would."""

from __future__ import annotations

import itertools
import platform
import shutil
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from analysis.simulation.fmu.archive import LINUX, compiler_missing, write_fmus
from analysis.simulation.model import Model, model_of
from analysis.simulation.simulate import (
    DrivingInput,
    Simulation,
    State,
    compiled,
    simulate,
)
from analysis.terms import baseline_of, make
from analysis.terms.base import Used
from rig.model.parse import InputError
from rig.model.rig import Rig
from rig.runs.rigs import load_rig
from tests.analysis.right_hand_side import rates_of

pytest.importorskip("fmpy")
if compiler_missing() or platform.machine() != "x86_64" or platform.system() != "Linux":
    pytest.skip("needs the package ziglang on 64-bit Linux", allow_module_level=True)

from fmpy import extract, read_model_description, simulate_fmu
from fmpy.fmi2 import FMU2Slave
from fmpy.model_description import ModelDescription
from fmpy.validation import validate_fmu

RATE, SECONDS = 1000.0, 3.0
AGREEMENT = 1e-4  # of a channel's range

EFFECTS = (
    ("valve_deadband", "joint 1", {"deadband_pos_1": 0.02, "deadband_neg_1": 0.03}),
    ("internal_leakage", "joint 2", {"c_internal_2": 2e-12}),
    ("coulomb_friction", "joint 2", {"Fc2": 80.0}),
)


@pytest.fixture(scope="module")
def shipped() -> Rig:
    return load_rig("shinshu-2dof")


@pytest.fixture(scope="module")
def model(shipped: Rig) -> Model:
    """A baseline with a dead band, a leak and a seal whose contact has a state of its own."""
    terms = [Used(term) for term in baseline_of(shipped)]
    values = dict(shipped.nominal)
    for name, where, known in EFFECTS:
        term = make(name, where)
        terms.append(Used(term, tuple(s.grid[0] for s in term.shapes(shipped))))
        values |= {c.parameter: 1e-12 for c in term.coefficients(shipped)} | known
    return model_of(shipped, terms, values)


@pytest.fixture(scope="module")
def units(model: Model, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("units")
    return write_fmus(model, folder, "arm", "a test", targets=(LINUX,))


@pytest.fixture(scope="module")
def drive(shipped: Rig) -> DrivingInput:
    t = np.arange(int(SECONDS * RATE) + 1) / RATE
    u = np.column_stack(
        [0.08 * np.sin(2 * np.pi * 1.0 * t), 0.07 * np.sin(2 * np.pi * 1.5 * t + 1.0)]
    )
    nothing = np.zeros_like(u)
    supply = shipped.supply.pressure * (1.0 + 0.01 * np.sin(2 * np.pi * 0.3 * t))
    oil = np.full(len(t), shipped.oil.temperature)
    still = np.zeros(2, dtype=bool)
    return DrivingInput(RATE, u, supply, oil, still, nothing, nothing, nothing)


def at_rest(rig: Rig) -> State:
    """Both pistons at mid-stroke, half the supply pressure in every chamber."""
    q = []
    for joint in rig.joints:
        a, c, length = joint.linkage.base_pin, joint.linkage.arm_pin, joint.linkage.mid_length
        beta = np.arccos((a**2 + c**2 - length**2) / (2 * a * c))
        q.append(beta - joint.linkage.offset)
    half = np.full(len(q), 0.5 * rig.supply.pressure)
    return State(np.array(q), np.zeros(len(q)), half, half)


@pytest.fixture(scope="module")
def wanted(model: Model, drive: DrivingInput, shipped: Rig) -> Simulation:
    result = simulate(model, drive, at_rest(shipped))
    assert not result.failure
    return result


def integrated_by_scipy(model: Model, drive: DrivingInput, samples: int) -> np.ndarray:
    """The first samples of the state (states, n + 1) by another integrator at a tight tolerance."""
    start = at_rest(model.rig)
    y = np.concatenate([start.q, start.qd, start.p_cap, start.p_rod, np.zeros(1)])
    t = np.arange(samples + 1) / RATE
    rates = rates_of(compiled(model), drive)
    options = {"method": "DOP853", "rtol": 1e-9, "atol": 1e-9, "max_step": 1 / RATE}
    return np.asarray(solve_ivp(rates, (0.0, t[-1]), y, t_eval=t, **options).y)


def inputs(drive: DrivingInput) -> np.ndarray:
    """The driving signals by time, as fmpy takes them."""
    names = ("time", "supply_pressure", "oil_temperature", "spool_1", "spool_2")
    t = np.arange(len(drive.u)) / drive.rate
    columns = (t, drive.p_s, drive.temperature, drive.u[:, 0], drive.u[:, 1])
    return np.array(list(zip(*columns, strict=True)), dtype=[(name, float) for name in names])


@dataclass
class Unit:
    """An unpacked unit of version 2 with fmpy's wrapper, its variables by name."""

    slave: FMU2Slave
    references: dict[str, int]

    def put(self, **values: float) -> None:
        self.slave.setReal([self.references[n] for n in values], list(values.values()))

    def get(self, *names: str) -> list[float]:
        return list(self.slave.getReal([self.references[n] for n in names]))


@pytest.fixture
def unit(units: Sequence[Path]) -> Iterator[Unit]:
    folder = extract(str(units[0]))
    about: ModelDescription = read_model_description(folder)
    slave = FMU2Slave(
        guid=about.guid, unzipDirectory=folder, instanceName="arm",
        modelIdentifier=about.coSimulation.modelIdentifier,
    )  # fmt: skip
    slave.instantiate()
    slave.setupExperiment(startTime=0.0)
    slave.enterInitializationMode()
    yield Unit(slave, {v.name: v.valueReference for v in about.modelVariables})
    slave.terminate()
    slave.freeInstance()
    shutil.rmtree(folder)


CHANNELS = ("piston", "cap_pressure", "rod_pressure")


def deviation(found: np.ndarray, wanted: Simulation, name: str) -> float:
    """Difference of a channel, root mean square over its range.

    Single samples differ by a little more: `simulate` takes longer steps and interpolates.
    """
    kind, joint = name.rsplit("_", 1)
    table = {"piston": wanted.piston, "cap_pressure": wanted.p_cap, "rod_pressure": wanted.p_rod}
    x = table[kind][:, int(joint) - 1]
    return float(np.sqrt(np.mean((found - x[: len(found)]) ** 2)) / np.ptp(x))


@pytest.mark.parametrize("version", [2, 3])
def test_a_unit_obeys_the_standard(units: Sequence[Path], version: int) -> None:
    assert validate_fmu(str(units[version - 2])) == []
    with zipfile.ZipFile(units[version - 2]) as archive:
        names = archive.namelist()
    assert {"sources/model.h", f"sources/fmi{version}.c"} <= set(names)
    assert any(name.endswith("/arm.so") for name in names)


def test_stepped_with_input_slopes_a_unit_moves_as_the_model(
    unit: Unit, drive: DrivingInput, wanted: Simulation, model: Model
) -> None:
    unit.slave.exitInitializationMode()
    names = [f"{kind}_{joint}" for joint in (1, 2) for kind in CHANNELS]
    signals = inputs(drive)
    driving = list(signals.dtype.names[1:])
    references = [unit.references[n] for n in driving]
    out = [unit.get(*names)]
    for now, later in itertools.pairwise(signals):
        unit.put(**{n: float(now[n]) for n in driving})
        slopes = [(later[n] - now[n]) * RATE for n in driving]
        unit.slave.setRealInputDerivatives(references, [1] * len(driving), slopes)
        unit.slave.doStep(currentCommunicationPoint=now["time"], communicationStepSize=1 / RATE)
        out.append(unit.get(*names))
    found = np.array(out)
    for k, name in enumerate(names):
        assert deviation(found[:, k], wanted, name) < AGREEMENT, name
    exact = integrated_by_scipy(model, drive, 500)
    for k, name in ((1, "cap_pressure_1"), (4, "cap_pressure_2")):
        x = exact[2 * 2 + int(name[-1]) - 1]
        assert np.abs(found[:501, k] - x).max() < AGREEMENT * np.ptp(x), name


@pytest.mark.parametrize("version", [2, 3])
def test_a_program_that_knows_no_slopes_lets_the_unit_extrapolate(
    units: Sequence[Path], drive: DrivingInput, wanted: Simulation, version: int
) -> None:
    result = simulate_fmu(
        str(units[version - 2]), stop_time=SECONDS, step_size=1 / RATE, output_interval=1 / RATE,
        input=inputs(drive), start_values={"extrapolate_inputs": True},
    )  # fmt: skip
    for joint in (1, 2):
        assert deviation(result[f"piston_{joint}"], wanted, f"piston_{joint}") < AGREEMENT


def test_a_locked_joint_stands_still_and_the_other_moves(units: Sequence[Path]) -> None:
    signals = [(t, 7e6, 40.0, 0.05, 0.05) for t in (0.0, 0.5)]
    names = ("time", "supply_pressure", "oil_temperature", "spool_1", "spool_2")
    result = simulate_fmu(
        str(units[0]), stop_time=0.5, output_interval=0.01,
        input=np.array(signals, dtype=[(n, float) for n in names]),
        start_values={"locked_1": True, "piston_1_start": 0.01},
    )  # fmt: skip
    np.testing.assert_allclose(result["piston_1"], 0.01, atol=1e-12)
    assert np.ptp(result["piston_2"]) > 1e-3


def test_a_state_kept_and_put_back_gives_the_same_future(unit: Unit) -> None:
    unit.slave.exitInitializationMode()
    unit.put(spool_1=0.05, spool_2=-0.05)
    unit.slave.doStep(0.0, 0.05)
    kept = unit.slave.getFMUstate()
    unit.slave.doStep(0.05, 0.05)
    first = unit.get("piston_1", "cap_pressure_2")
    unit.slave.setFMUstate(kept)
    unit.slave.doStep(0.05, 0.05)
    assert unit.get("piston_1", "cap_pressure_2") == first
    unit.slave.freeFMUstate(kept)


def test_a_state_that_ceases_to_exist_is_an_error_with_a_reason(
    unit: Unit, capfd: pytest.CaptureFixture[str]
) -> None:
    unit.slave.exitInitializationMode()
    unit.put(spool_1=5.0, spool_2=5.0)
    with pytest.raises(Exception, match="fmi2DoStep failed"):
        unit.slave.doStep(0.0, 10.0)


def test_the_identified_parameters_can_be_read(unit: Unit, model: Model) -> None:
    unit.slave.exitInitializationMode()
    for name in ("M1", "b", "c_internal_2"):
        assert unit.get(f"parameters.{name}") == [model.values[name]]


def test_the_same_model_makes_the_same_file(
    model: Model, units: Sequence[Path], tmp_path: Path
) -> None:
    said: list[str] = []
    again = write_fmus(model, tmp_path, "arm", "a test", targets=(LINUX,), progress=said.append)
    assert [line.split(":")[0] for line in said] == ["compiling 1 of 2", "compiling 2 of 2"]
    assert [f.read_bytes() for f in again] == [f.read_bytes() for f in units]


def test_a_model_with_a_gap_is_refused_by_name(shipped: Rig, tmp_path: Path) -> None:
    terms = [Used(term) for term in baseline_of(shipped)]
    gap = model_of(shipped, terms, {**shipped.nominal, "Fv2": float("nan")})
    with pytest.raises(InputError, match="Fv2 not identified"):
        write_fmus(gap, tmp_path, "arm", "a test", targets=(LINUX,))
