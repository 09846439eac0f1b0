"""The page about the wire says what the code does."""

from __future__ import annotations

import re
import socket
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from drivers.modbus_blocks import BlockDecoder
from rig.model.wire import registers as reg
from rig.model.wire.registers import Refusal, Status, TripCause
from tests.drivers.wires import device_process
from tests.hil_sim.integrator import seed_rig

PAGE = (Path(__file__).parents[2] / "docs" / "wire-modbus-tcp.md").read_text("utf-8")
ROW = re.compile(r"^\| 0x([0-9A-F]{4}) \| `(\w+)` \| (\d+) \| (\w+) \| (\w+) \| (.+) \|$", re.M)


def listing(title: str) -> bytes:
    """The bytes of an example: what stands before two spaces in each line."""
    text = re.search(rf"```\n{title}\n(.*?)```", PAGE, re.S)
    assert text is not None
    lines = [line.split("  ")[0] for line in text[1].splitlines() if not line.startswith("...")]
    return bytes.fromhex("".join(lines))


def test_every_register_stands_on_the_page_as_in_the_code() -> None:
    rows = [
        reg.Register(name, int(address, 16), int(words), form, access)
        for address, name, words, form, access, _ in ROW.findall(PAGE)
    ]
    assert len(rows) == len(reg.REGISTERS) > 30
    assert sorted(rows, key=lambda r: r.address) == sorted(reg.REGISTERS, key=lambda r: r.address)


def test_registers_do_not_overlap() -> None:
    ordered = sorted(reg.REGISTERS, key=lambda r: r.address)
    assert all(a.end <= b.address for a, b in pairwise(ordered))


def test_codes_and_bits_are_those_of_the_page() -> None:
    meanings = {name: text for _, name, _, _, _, text in ROW.findall(PAGE)}
    status = {int(v): n for v, n in re.findall(r"(\d+) (\w+)", meanings["status"])}
    assert {1, 2, 4, 8, 16} <= set(status)
    assert [status[b] for b in (1, 2, 4)] == ["streaming", "tripped", "armed"]
    assert Status.STREAMING | Status.TRIPPED | Status.ARMED == 7
    assert (Status.BLOCK, Status.CONTROLLED) == (8, 16)
    for cause in TripCause:
        assert re.search(rf"\b{int(cause)} \w+", meanings["trip_cause"])
    assert f"0x{reg.RESET_KEY:04X}" in meanings["reset"]
    assert f"0x{reg.MAGIC:08X}" in meanings["magic"]
    assert str(reg.WAVE_CAPACITY) in meanings["wave_capacity"]
    table = PAGE.split("## Errors")[1].split("\n\n")[0]
    listed = {
        int(c) for row in re.findall(r"^\| \d \| ([\d, ]+) \|", table, re.M) for c in row.split(",")
    }
    assert listed == {int(r) for r in Refusal if r != Refusal.NONE}


def exchange(wire: socket.socket, request: bytes) -> bytes:
    wire.sendall(request)
    answer = b""
    while len(answer) < 6 or len(answer) < 6 + int.from_bytes(answer[4:6], "big"):
        answer += wire.recv(4096)
    return answer


def test_a_stranger_with_nothing_but_the_page_gets_the_bytes_on_the_page() -> None:
    def frame(tid: int, pdu: str) -> bytes:
        body = b"\x01" + bytes.fromhex(pdu)
        return tid.to_bytes(2, "big") + b"\0\0" + len(body).to_bytes(2, "big") + body

    with (
        device_process("virtual") as (_, port),
        socket.create_connection(("127.0.0.1", port), timeout=20) as wire,
    ):
        assert exchange(wire, frame(1, "03 0000 0002"))[9:] == b"BRAM"
        assert exchange(wire, frame(2, "06 0083 0001")).endswith(bytes.fromhex("06 0083 0001"))
        for k in range(5):
            acknowledge = (k - 1) & 0xFFFF
            pdu = f"17 0100 007D 0080 0002 04 {acknowledge:04X} {k + 1:04X}"
            answer = exchange(wire, frame(2, pdu))
            assert answer[9:11] == k.to_bytes(2, "big")
        answer = exchange(wire, listing("request"))
    printed = listing("answer")
    assert answer[:19] == printed[:19]
    assert len(answer) == 6 + 253


def test_the_printed_answer_decodes_to_the_printed_values() -> None:
    printed = listing("answer")
    row = printed[19:]
    assert len(row) == 24
    header = reg.unpack_header(printed[9:19])
    assert (header.sequence, header.tick, header.backlog) == (5, 50, 0)
    decoder = BlockDecoder(seed_rig())
    decoder.restart(50)
    data = decoder.decode(reg.BlockHeader(0, 50, header.status, 0), printed[9:19] + 10 * row).data
    printed_values = [
        30.5e-6,
        0.61e-6,
        1.999986e6,
        1.999986e6,
        0.199985,
        0.61e-6,
        1.999986e6,
        1.999986e6,
        6.999976e6,
        40.0,
        0.498290,
        -0.498290,
    ]
    assert np.all(data == data[0])
    assert data[0] == pytest.approx(printed_values, rel=2e-3)
