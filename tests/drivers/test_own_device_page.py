"""What the pages for people with their own device show can be read and run as it stands."""

from __future__ import annotations

import re
import sys
from importlib.resources import files
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import urlsplit

import pytest

from drivers.base import DeviceError, DeviceLost, OutputLaw
from drivers.conformance import CheckVerdict, live_subject, run
from drivers.modbus_map import InputEntry, MapSettings, OutputEntry, register_map
from drivers.nidaqmx_card import CardInput, CardOutput, CardSettings, wiring
from drivers.polled import InputsOutputs, PolledDriver
from drivers.register_types import RegisterType
from rig.bench.latch import BenchState
from rig.model.parse import parse_model
from rig.model.parts import Wire
from rig.model.rig import Rig
from rig.model.wire.resample import LONGEST
from tests.hil_sim.integrator import seed_rig

DOCS = Path(__file__).parents[2] / "docs"
MAP_PAGE = (DOCS / "wire-modbus-map.md").read_text("utf-8")
OWN_PAGE = (DOCS / "own-device.md").read_text("utf-8")


def listing(page: str, language: str) -> str:
    found = re.search(rf"```{language}\n(.*?)```", page, re.S)
    assert found is not None
    return found[1]


def boom(wire: str) -> Rig:
    text = (files("rig") / "shipped" / "boom-1dof.yaml").read_text("utf-8")
    return parse_model(Rig, re.sub(r"^wire:.*$", lambda _: wire, text, flags=re.M), "boom.yaml")


def test_the_pages_maps_fit_the_shipped_bench_of_one_joint() -> None:
    mapped = boom(listing(MAP_PAGE, "yaml"))
    found = register_map(MapSettings.of(mapped.wire), mapped)
    assert found.watchdog is not None
    wired = boom(listing(OWN_PAGE, "yaml"))
    assert wiring(CardSettings.of(wired.wire), wired).outputs == ("Dev1/ao0",)


def test_every_key_and_type_stands_on_its_page() -> None:
    for model in (MapSettings, InputEntry, OutputEntry):
        for name in model.model_fields:
            assert re.search(rf"^\|.*`{name}`", MAP_PAGE, re.M), name
    for form in RegisterType:
        assert f"`{form}`" in MAP_PAGE
    for model in (CardInput, CardOutput, CardSettings):
        for name in model.model_fields:
            assert re.search(rf"`{name}[`:]|\b{name}:", OWN_PAGE), name
    assert f"{LONGEST:g} periods" in OWN_PAGE
    assert "No card was at hand" in OWN_PAGE


class Line:
    """The line that the page's example speaks over."""

    def __init__(self) -> None:
        self.sent: list[str] = []
        self.channels = "0.001 " * 10

    def write(self, text: str) -> None:
        self.sent.append(text)

    def ask(self, text: str) -> str:
        if self.channels == "off":
            sys.exit(0)
        return "seven" if text == "name" else self.channels

    def close(self) -> None:
        pass


@pytest.mark.parametrize(
    ("channels", "kind", "words"),
    [
        ("", DeviceLost, "switched on"),
        ("off", DeviceError, "failed: SystemExit: 0"),  # the library ends the program
    ],
)
def test_the_pages_small_class_is_a_driver(
    channels: str, kind: type[Exception], words: str
) -> None:
    line = Line()
    names: dict[str, Any] = {"open_line": lambda _: line, "__name__": "my_bench.gauge"}
    exec(compile(listing(OWN_PAGE, "python"), "own-device.md", "exec"), names)
    rig = seed_rig().model_copy(update={"sample_rate": 100.0})
    wire = Wire(kind="gauge-box", timeout=0.2, watchdog=0.5, address="COM3")  # type: ignore[call-arg]
    assert wire.endpoint == "gauge-box://COM3"
    other = {"address": "COM4"}
    assert names["GaugeSettings"].of_endpoint(urlsplit("gauge-box://COM4")) == other
    # A trip at one box is not reset at the other.
    assert BenchState(wire).folder != BenchState(wire.reached_by("gauge-box", other)).folder
    driver = names["GaugeDriver"](wire, rig)
    assert isinstance(driver, PolledDriver)
    box: InputsOutputs = names["GaugeBox"](line)
    assert box.watchdog == 0.2
    assert driver.connect().identity == "gauge box seven"
    driver.start()
    driver.apply([OutputLaw(bias=1.0, limit=2.0), OutputLaw()])
    assert driver.read_block().data.shape[1] == 12
    assert line.sent[-1] == "put 1.0000 0.0000"
    line.channels = channels
    with pytest.raises(kind, match=words):
        driver.read_block()
    assert line.sent[-1] == "put 0.0000 0.0000"
    driver.close()


def test_the_pages_driver_passes_the_checks_that_move_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    names: dict[str, Any] = {"open_line": lambda _: Line(), "__name__": "my_bench.gauge"}
    exec(compile(listing(OWN_PAGE, "python"), "own-device.md", "exec"), names)
    installed = SimpleNamespace(load=lambda: names["GaugeDriver"])
    found = SimpleNamespace(select=lambda **_: [installed])
    monkeypatch.setattr("drivers.registry._installed", lambda: found)
    wire = Wire(kind="gauge-box", timeout=0.2, watchdog=0.5, address="COM3")  # type: ignore[call-arg]
    rig = seed_rig().model_copy(update={"sample_rate": 100.0, "wire": wire})
    report = run(live_subject(rig), outputs=False)
    assert not report.of(CheckVerdict.FAILED)
    assert len(report.of(CheckVerdict.PASSED)) >= 8
    # The box holds neither a rate nor a rig that `connect` could compare.
    skipped = {result.check: result.reason for result in report.of(CheckVerdict.SKIPPED)}
    assert skipped["other_rig_refused"] == "not claimed: refusal of other rigs"


def test_the_page_names_every_call_of_a_whole_driver() -> None:
    from drivers.base import Driver

    calls = [name for name, value in vars(Driver).items() if callable(value) and name[0] != "_"]
    assert len(calls) == 10
    for name in calls:
        assert f"`{name}`" in OWN_PAGE, name
