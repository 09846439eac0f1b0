"""The worked DAQ card, against a stand-in for the calls of the package `nidaqmx` it makes."""

from __future__ import annotations

import sys
from collections import namedtuple
from collections.abc import Iterator
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from drivers.base import OFF, DeviceLost, OutputLaw
from drivers.nidaqmx_card import CardSettings, NidaqmxDriver, wiring
from rig.model.parse import InputError, parse_model
from rig.model.rig import Rig
from tests.drivers.polled_bench import FakeClock
from tests.drivers.test_modbus_map import rig_text

WIRE = """
wire:
  kind: nidaqmx
  timeout: 0.2 s
  watchdog: 0.5 s
  inputs:
    spool_1: {channel: Dev1/ai0, scale: 1 V/V, range: 5 V}
    piston_1: {channel: Dev1/ai1, scale: 8 mm/V}
    cap_pressure_1: {channel: Dev1/ai2, scale: 1 MPa/V, offset: -0.1 MPa}
    rod_pressure_1: {channel: Dev1/ai3, scale: 10 bar/V}
    spool_2: {channel: Dev1/ai4, scale: 1 V/V, range: 5 V}
    piston_2: {channel: Dev1/ai5, scale: -8 mm/V, offset: 1 mm}
    cap_pressure_2: {channel: Dev1/ai6, scale: 1 MPa/V}
    rod_pressure_2: {channel: Dev1/ai7, scale: 1 MPa/V}
    supply_pressure: {channel: Dev1/ai8, scale: 1 MPa/V}
    oil_temperature: {channel: Dev1/ai9, scale: 10 delta_degC/V, offset: 5 degC}
  outputs:
    1: {channel: Dev1/ao0}
    2: {channel: Dev1/ao1}
  zero_by: {device: Dev1, milliseconds: 300}
"""


class PackageError(Exception):
    pass


class DaqError(PackageError):
    pass


class Package:
    """What the card does to the package: its calls, what it reads, and whether it fails."""

    def __init__(self) -> None:
        self.calls: list[tuple[str, object]] = []
        self.volts = np.linspace(0.5, 1.4, 10)
        self.out: list[list[float]] = []
        self.failing = ""

    def note(self, call: str, about: object = None) -> None:
        self.calls.append((call, about))
        if call == self.failing:
            raise DaqError("the device is not available\n\nStatus Code: -201003")


def stand_in(package: Package) -> dict[str, ModuleType]:
    """Modules with the package's names; signatures as in its version 1.7."""

    class Task:
        def __init__(self, new_task_name: str = "") -> None:
            package.note("Task")
            self.ai_channels = SimpleNamespace(add_ai_voltage_chan=self._input)
            self.ao_channels = SimpleNamespace(add_ao_voltage_chan=self._output)

        def _input(
            self, physical_channel: str, min_val: float = -5.0, max_val: float = 5.0
        ) -> None:
            package.note("input", (physical_channel, min_val, max_val))

        def _output(
            self, physical_channel: str, min_val: float = -10.0, max_val: float = 10.0
        ) -> None:
            package.note("output", (physical_channel, min_val, max_val))

        def start(self) -> None:
            package.note("start")

        def read(self, timeout: float = 10.0) -> list[float]:
            package.note("read", timeout)
            return package.volts.tolist()

        def write(self, data: list[float], auto_start: bool = False, timeout: float = 10.0) -> int:
            assert auto_start
            package.note("write", data)
            package.out.append(data)
            return 1

        def close(self) -> None:
            package.note("close")

    class WatchdogTask:
        def __init__(self, device_name: str, task_name: str = "", timeout: float = 10) -> None:
            package.note("WatchdogTask", (device_name, timeout))

        def cfg_watchdog_ao_expir_states(self, expiration_states: list[tuple[object, ...]]) -> None:
            package.note("expire", [tuple(state) for state in expiration_states])

        def start(self) -> None:
            package.note("start watchdog")

        def reset_timer(self) -> None:
            package.note("reset_timer")

        def close(self) -> None:
            package.note("close")

    names = {name: ModuleType(f"nidaqmx.{name}") for name in ("constants", "errors", "system")}
    top = ModuleType("nidaqmx")
    top.__path__ = []
    vars(top).update(Task=Task, DaqError=DaqError, **names)
    vars(names["errors"]).update(DaqError=DaqError, Error=PackageError)
    vars(names["constants"]).update(WatchdogAOExpirState=SimpleNamespace(VOLTAGE="voltage"))
    state = namedtuple("AOExpirationState", ["physical_channel", "expiration_state", "output_type"])
    vars(names["system"]).update(WatchdogTask=WatchdogTask, AOExpirationState=state)
    return {"nidaqmx": top, **{f"nidaqmx.{name}": module for name, module in names.items()}}


@pytest.fixture
def package(monkeypatch: pytest.MonkeyPatch) -> Iterator[Package]:
    package = Package()
    for name, module in stand_in(package).items():
        monkeypatch.setitem(sys.modules, name, module)
    return package


def rig_of(change: tuple[str, str] | None = None) -> Rig:
    wire = WIRE
    if change is not None:
        assert change[0] in wire
        wire = wire.replace(*change)
    return parse_model(Rig, rig_text(wire), "card.yaml")


def connected(rig: Rig) -> tuple[NidaqmxDriver, str]:
    clock = FakeClock()
    driver = NidaqmxDriver(rig.wire, rig, clock=clock, sleep=clock.sleep)
    return driver, driver.connect().identity


def test_channels_are_opened_in_the_order_of_the_rig_with_their_ranges(package: Package) -> None:
    driver, identity = connected(rig_of())
    assert identity == "DAQ card Dev1"
    inputs = [about for call, about in package.calls if call == "input"]
    assert inputs[:2] == [("Dev1/ai0", -5.0, 5.0), ("Dev1/ai1", -10.0, 10.0)]
    assert [about[0] for about in inputs] == [f"Dev1/ai{k}" for k in range(10)]  # type: ignore[index]
    outputs = [about for call, about in package.calls if call == "output"]
    assert outputs == [("Dev1/ao0", -10.0, 10.0), ("Dev1/ao1", -10.0, 10.0)]
    assert package.out[0] == [0.0, 0.0]
    driver.close()
    assert [call for call, _ in package.calls].count("close") == 3


def test_volts_become_si_by_scale_and_offset(package: Package) -> None:
    driver, _ = connected(rig_of())
    driver.start()
    row = driver.read_block().data[0]
    expected = [0.5, 4.8e-3, 0.6e6, 0.8e6, 0.9, -7e-3, 1.1e6, 1.2e6, 1.3e6, 19.0]
    assert row[:10] == pytest.approx(expected)


def test_the_card_puts_out_the_law_and_its_watchdog_is_fed(package: Package) -> None:
    driver, _ = connected(rig_of())
    calls = dict(package.calls)
    assert calls["WatchdogTask"] == ("Dev1", 0.3)
    assert calls["expire"] == [("Dev1/ao0", 0.0, "voltage"), ("Dev1/ao1", 0.0, "voltage")]
    driver.start()
    driver.apply([OutputLaw(bias=1.5, limit=2.0), OutputLaw(bias=-3.0, limit=1.0)])
    package.calls.clear()
    driver.read_block()
    assert package.out[-1] == [1.5, -1.0]
    names = [call for call, _ in package.calls]
    assert names == ["read", "write", "reset_timer"] * 5
    assert ("read", 0.2) in package.calls
    driver.zero_outputs()
    assert package.out[-1] == [0.0, 0.0]


def test_a_card_that_fails_is_lost_with_the_first_line_of_its_message(package: Package) -> None:
    driver, _ = connected(rig_of())
    driver.start()
    driver.apply([OutputLaw(bias=1.0, limit=2.0), OFF])
    driver.read_block()
    package.failing = "read"
    with pytest.raises(DeviceLost, match=r"^the DAQ card failed: the device is not available$"):
        driver.read_block()
    assert package.out[-1] == [0.0, 0.0]
    package.failing = "write"
    with pytest.raises(DeviceLost):
        driver.zero_outputs()
    package.failing = "Task"
    with pytest.raises(DeviceLost):
        driver.zero_outputs()
    package.failing = ""
    package.out.clear()
    driver.zero_outputs()
    assert package.out == [[0.0, 0.0]]


def test_a_package_that_is_not_installed_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "nidaqmx", None)
    rig = rig_of()
    with pytest.raises(InputError, match=r"install nidaqmx \(pip install nidaqmx\)"):
        NidaqmxDriver(rig.wire, rig)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("scale: 8 mm/V}", "scale: 8 mm}"), r"inputs.piston_1.scale: unit 'mm' is of another"),
        (("Dev1/ai1,", "ai1,"), r"inputs.piston_1.channel: "),
        (("Dev1/ai1,", "Dev1/ai1:3,"), r"inputs.piston_1.channel: "),
        (
            ("Dev1/ai1,", "Dev1/ai0,"),
            r"inputs.piston_1.channel: Dev1/ai0 is that of inputs.spool_1",
        ),
        (("range: 5 V", "range: 0 V"), r"inputs.spool_1.range: 0 V, expected one above"),
        (("scale: 8 mm/V}", "scale: 8 mm/V, range: 2 V}"), r"inputs.piston_1: its numbers end at "),
        (("range: 5 V", "range: 5"), r"inputs.spool_1.range: .*has no unit"),
        (("2: {channel: Dev1/ao1}", "2: {channel: Dev1/ao0}"), r"outputs.2.channel: Dev1/ao0 is"),
        (("device: Dev1, ", ""), r"zero_by.device: is missing"),
        (("{device: Dev1, milliseconds: 300}", "none"), r"zero_by: .* accept_no_watchdog: true"),
        (("milliseconds: 300", "milliseconds: 900"), r"zeroes its outputs after 0.9 s"),
    ],
)
def test_wrong_wiring_is_refused_by_the_name_of_its_key(
    package: Package, change: tuple[str, str], said: str
) -> None:
    rig = rig_of(change)
    with pytest.raises(InputError, match=said):
        NidaqmxDriver(rig.wire, rig)


def test_wiring_needs_no_package() -> None:
    rig = rig_of()
    assert rig.wire.endpoint == "nidaqmx://Dev1"  # trips are stored by it: cards differ
    assert wiring(CardSettings.of(rig.wire), rig).outputs == ("Dev1/ao0", "Dev1/ao1")
