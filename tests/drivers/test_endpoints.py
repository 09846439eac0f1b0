"""An endpoint that a message names is typed again and reaches the same bench, on every wire."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable
from pathlib import Path
from urllib.parse import urlencode

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.registry import driver_class, wire_at, wire_kinds
from rig.model.parse import InputError
from rig.model.trips import reset_command
from tests.hil_sim.integrator import seed_rig

WORD = st.from_regex(r"[A-Za-z0-9_.,+ -]*[A-Za-z0-9_]", fullmatch=True)
PATH = st.lists(WORD, min_size=1, max_size=3).map(lambda words: "/" + "/".join(words))
HOST = st.ip_addresses(v=4).map(str) | st.ip_addresses(v=6).map("[{}]".format)
PORT = st.integers(1, 65535)
BAUD = {"baud": st.sampled_from([9600, 921600])}
BUS = st.sampled_from(["socketcan/can0", "slcan/dev/ttyACM0", "socketcand/[::1]:29536/can0"])
RATE = {"bitrate": st.sampled_from([125_000, 1_000_000])}

Strategy = st.SearchStrategy[str]


def with_options(place: Strategy, **options: st.SearchStrategy[object]) -> Strategy:
    """The place of a device, and any of the options behind it."""
    chosen = st.fixed_dictionaries({}, optional=options)
    return st.builds(lambda at, more: f"{at}{'?' if more else ''}{urlencode(more)}", place, chosen)


# What stands behind KIND://; None for a kind whose tables an endpoint cannot describe.
PLACES: dict[str, Strategy | None] = {
    "modbus-tcp": st.builds("{}:{}".format, HOST | st.just("bench.local"), PORT),
    "modbus-rtu": with_options(PATH, parity=st.sampled_from("NEO"), **BAUD),
    "serial": with_options(PATH | st.just("COM3"), **BAUD),
    "can": with_options(BUS, dbc=PATH, **RATE),
    "canopen-408": with_options(BUS, eds=PATH, **RATE),
    "replay": with_options(
        PATH, pace=st.floats(0.0, 10.0), ignore_outputs=st.sampled_from(["true", "false"]),
        block_samples=st.integers(1, 100),
    ),
    "in-process": st.just("package.module:name"),
    "modbus-map": None,
    "nidaqmx": None,
}  # fmt: skip


@pytest.mark.parametrize("kind", wire_kinds())
def test_the_command_that_resets_a_bench_reaches_that_bench(kind: str) -> None:
    place = PLACES[kind]
    if place is None:
        with pytest.raises(InputError, match=f"--endpoint {kind}://here: expected"):
            wire_at(f"{kind}://here", seed_rig().wire)
        return
    given(place)(_reaches(kind))()


def test_what_an_endpoint_has_no_form_for_is_kept_from_the_rig_file() -> None:
    nodes = wire_at("canopen-408://socketcan/can0", seed_rig().wire)
    nodes = nodes.reached_by("canopen-408", {**nodes.settings, "nodes": [5, 6]})
    assert wire_at(nodes.endpoint, nodes) == nodes
    other = wire_at("canopen-408://socketcan/can1?bitrate=125000", nodes)
    assert driver_class("canopen-408").settings.of(other).nodes == (5, 6)
    card = nodes.reached_by("nidaqmx", {"inputs": {}, "outputs": {1: {"channel": "Dev1/ao0"}}})
    assert wire_at("nidaqmx://Dev1", card) == card


def _reaches(kind: str) -> Callable[[str], None]:
    def same(place: str) -> None:
        rig = seed_rig()
        wire = wire_at(f"{kind}://{place}", rig.wire)
        settings = driver_class(kind).settings.of(wire)
        command = reset_command(rig.model_copy(update={"wire": wire}))
        words = shlex.split(command)
        again = wire_at(words[words.index("--endpoint") + 1], rig.wire)
        assert again == wire
        assert driver_class(kind).settings.of(again) == settings

    return same


@pytest.mark.parametrize("kind", [kind for kind in wire_kinds() if PLACES[kind] is not None])
def test_the_page_of_rig_files_names_every_key_of_every_wire(kind: str) -> None:
    page = (Path(__file__).parents[2] / "docs" / "rig-files.md").read_text(encoding="utf-8")
    _, _, keys = page.partition(f"`{kind}`")
    keys = keys.partition(";")[0]
    assert set(driver_class(kind).settings.model_fields) <= set(re.findall(r"`(\w+)`", keys))


def test_a_trip_of_a_replayed_run_names_how_it_was_played() -> None:
    rig, endpoint = seed_rig(), "replay:///runs/monday?ignore_outputs=true"
    played = rig.model_copy(update={"wire": wire_at(endpoint, rig.wire)})
    assert f"--endpoint '{endpoint}' --reason" in reset_command(played)


def test_a_time_of_the_wire_is_no_option_of_an_endpoint() -> None:
    with pytest.raises(InputError, match=r"timeout=1: expected one like modbus-rtu:///dev/ttyUSB0"):
        wire_at("modbus-rtu:///dev/ttyUSB0?timeout=1", seed_rig().wire)
