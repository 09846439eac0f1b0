"""The page about CiA 408 says what Python and the EDS file do."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from drivers.canopen_408 import ValveBusSettings
from rig.model.wire import cia408
from rig.model.wire.cia408 import ValveState, next_state

canopen = pytest.importorskip("canopen")
PAGE = (Path(__file__).parents[2] / "docs" / "wire-canopen-408.md").read_text("utf-8")
EDS = Path(__file__).parents[2] / "rig" / "shipped" / "valve-408.eds"


def test_every_object_of_the_page_is_in_the_file() -> None:
    valve = canopen.import_od(str(EDS), 1)
    listed = re.findall(r"^\| 0x([0-9A-F]{4})(?: sub (\d))? \|", PAGE, re.M)
    assert len(listed) == 9
    for index, sub in listed:
        found = valve[int(index, 16)]
        if sub:
            assert found[int(sub)].data_type is not None
    assert valve[0x1000].default & 0xFFFF == cia408.DEVICE_TYPE
    assert "0x4000" in PAGE
    assert cia408.FULL_SCALE == 0x4000


def test_the_states_of_the_page_are_those_of_both_ends() -> None:
    rows = re.findall(r"^\| `(\w+)` \| ([01]{4}) \| .* \| (.*) \|$", PAGE, re.M)
    assert {name: int(bits, 2) for name, bits, _ in rows} == {s.name: int(s) for s in ValveState}
    for name, _, leaves in rows:
        state = ValveState[name]
        if state.in_fault:
            assert "reset" in leaves
            continue
        for word in re.findall(r"\b\d\b", leaves):
            assert next_state(state, 0, int(word)) != state


def test_the_keys_of_the_page_are_those_of_the_driver() -> None:
    table = PAGE.split("## The rig file")[1].split("## Objects")[0]
    keys = set(re.findall(r"`(\w+)`", "".join(re.findall(r"^\| (.*?) \|", table, re.M))))
    assert keys == {*ValveBusSettings.model_fields, "watchdog"}
