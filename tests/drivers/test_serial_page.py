"""The page about the serial wire says what Python and C do."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import drivers.message_link
from drivers.base import OFF, DeviceError, OutputLaw
from drivers.serial_stream import SerialStreamDriver
from rig.model.parts import Wire
from rig.model.wire import frames
from rig.model.wire import registers as reg
from rig.model.wire import serial_messages as msg
from rig.model.wire.registers import Refusal
from rig.model.wire.serial_messages import Message
from tests.drivers.firmware import FIRMWARE, compile_c
from tests.drivers.serial_lines import Loop
from tests.hil_sim.integrator import seed_rig

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "wire-serial.md").read_text("utf-8")
SOURCE = (FIRMWARE / "serial_device.c").read_text("utf-8")
HEADER = (FIRMWARE / "serial_device.h").read_text("utf-8")
SESSION = 0x1A2B3C4D


def test_every_message_stands_on_the_page_and_in_the_c_source() -> None:
    expected = {message.name: int(message) for message in Message}
    on_page = re.findall(r"^\| 0x([0-9A-F]{2}) \| `(\w+)` \|", PAGE, re.M)
    assert {name: int(code, 16) for code, name in on_page} == expected
    enum = re.search(r"enum message \{(.*?)\}", SOURCE, re.S)
    assert enum is not None
    in_c = dict(re.findall(r"(\w+) = (0x[0-9A-F]{2})", enum[1]))
    assert {name: int(code, 16) for name, code in in_c.items()} == expected


def test_sizes_and_codes_are_those_of_the_page() -> None:
    reasons = re.findall(r"^\| (\d) \| (?!`|\d)", PAGE.split("| Reason")[1].split("###")[0], re.M)
    assert [int(reason) for reason in reasons] == [r for r in Refusal if r != Refusal.NONE]
    assert f"at most {frames.MAX_ENCODED} bytes" in PAGE
    assert f"0 to {frames.MAX_PAYLOAD}" in PAGE
    assert f"at most {msg.WINDOW} ahead" in PAGE
    assert f"1 to {msg.PAGE_SAMPLES} samples" in PAGE
    needed = msg.line_rate(reg.block_layout(10, 2), 1000.0)
    assert f"{needed:.0f}"[:3] == "268"
    assert f"SD_MAX_PAYLOAD {frames.MAX_PAYLOAD}" in HEADER
    assert f"WINDOW = {msg.WINDOW}," in SOURCE
    assert f"PAGE_SAMPLES = {msg.PAGE_SAMPLES} " in SOURCE
    assert f"SD_WAVE_CAPACITY {reg.WAVE_CAPACITY}" in HEADER


def spoken(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The bytes of a little session, as the page prints them."""
    monkeypatch.setattr(drivers.message_link.secrets, "randbits", lambda _bits: SESSION)
    loop = Loop(realtime=False)
    lines: list[tuple[str, bytes]] = []
    for arrow, faults in (("->", loop.forth), ("<-", loop.back)):

        def heard(data: bytes, arrow: str = arrow) -> list[bytes]:
            lines.append((arrow, data))
            return [data]

        monkeypatch.setattr(faults, "pass_on", heard)
    wire = Wire(kind="serial", device="loop", watchdog=0.5)
    driver = SerialStreamDriver(wire, seed_rig(), transport=loop, clock=loop.clock)
    driver.connect()
    driver._heartbeat = 8
    driver.start()
    driver.apply([OutputLaw(bias=0.5, limit=1.0), OFF])
    driver.read_block()
    with pytest.raises(DeviceError, match="out of range"):
        driver.apply([OFF, OutputLaw(limit=-1.0)])
    driver.close()
    return [f"{arrow} {data.hex(' ').upper()}" for arrow, data in lines]


def test_the_printed_bytes_are_those_of_a_session(monkeypatch: pytest.MonkeyPatch) -> None:
    listing = re.search(r"## Bytes of a session.*?```\n(.*?)```", PAGE, re.S)
    assert listing is not None
    printed: list[str] = []
    for text in listing[1].splitlines():
        # Bytes, then what they mean after three spaces; a line that goes on is indented.
        line = re.split(r"(?<=\S)   ", text)[0].strip()
        if text.startswith(("->", "<-")):
            printed.append(line)
        else:
            printed[-1] += " " + line
    said = spoken(monkeypatch)
    assert len(printed) == len(said) > 10
    for page, wire in zip(printed, said, strict=True):
        begin, more, _ = page.partition(" ...")
        assert wire.startswith(begin) if more else wire == page


def test_the_c_core_asks_nothing_of_an_operating_system(tmp_path: Path) -> None:
    includes = set(re.findall(r"#include <([\w.]+)>", SOURCE + HEADER))
    assert includes == {"stddef.h", "stdint.h", "string.h"}
    small = ["-DSD_MAX_JOINTS=2", "-DSD_WAVE_CAPACITY=8192", "-DSD_QUEUE_BLOCKS=100"]
    probe = tmp_path / "size.c"
    check = "char fits[sizeof(sd_device) <= 100 * 1024 ? 1 : -1];"
    probe.write_text(f'#include "serial_device.h"\n{check}\n', "utf-8")
    compile_c(*small, "-c", f"-I{FIRMWARE}", str(probe), "-o", str(tmp_path / "size.o"))
