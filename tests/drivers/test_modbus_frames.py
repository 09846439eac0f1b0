"""Requests and answers as bytes, beside those that pymodbus makes of the same."""

from __future__ import annotations

import pytest
from pymodbus.framer import FramerRTU, FramerSocket
from pymodbus.framer.base import FramerBase
from pymodbus.pdu import DecodePDU, ModbusPDU
from pymodbus.pdu.register_message import (
    ReadHoldingRegistersRequest,
    ReadInputRegistersRequest,
    ReadWriteMultipleRegistersRequest,
    WriteMultipleRegistersRequest,
    WriteSingleRegisterRequest,
)

from drivers.modbus_frames import (
    READ_HOLDING,
    READ_INPUT,
    payload_of,
    read_request,
    read_rtu_answer,
    read_tcp_frame,
    rtu_frame,
    tcp_frame,
    write_and_read_request,
    write_request,
)

UNIT, NUMBER = 9, 0xA1B2
PAIRS: tuple[tuple[bytes, ModbusPDU], ...] = (
    (read_request(READ_HOLDING, 0x0100, 125), ReadHoldingRegistersRequest(address=256, count=125)),
    (read_request(READ_INPUT, 7, 1), ReadInputRegistersRequest(address=7, count=1)),
    (write_request(0x82, [1]), WriteSingleRegisterRequest(address=0x82, registers=[1])),
    (
        write_request(0x200, [1, 65535, 3]),
        WriteMultipleRegistersRequest(address=0x200, registers=[1, 65535, 3]),
    ),
    (
        write_and_read_request(0x80, [5, 6], 0x100, 105),
        ReadWriteMultipleRegistersRequest(
            read_address=0x100, read_count=105, write_address=0x80, write_registers=[5, 6]
        ),
    ),
)


@pytest.mark.parametrize(("own", "other"), PAIRS)
def test_requests_and_frames_are_those_of_another_library(own: bytes, other: ModbusPDU) -> None:
    other.dev_id, other.transaction_id = UNIT, NUMBER
    framers: tuple[FramerBase, ...] = (FramerSocket(DecodePDU(True)), FramerRTU(DecodePDU(True)))
    over_tcp, over_rtu = (framer.buildFrame(other) for framer in framers)
    assert tcp_frame(NUMBER, UNIT, own) == over_tcp
    assert rtu_frame(UNIT, own) == over_rtu


def test_a_frame_of_tcp_is_read_when_it_is_whole_and_leaves_the_next() -> None:
    frame = tcp_frame(NUMBER, UNIT, b"\x03\x02\x00\x05")
    for length in range(len(frame)):
        assert read_tcp_frame(frame[:length]) is None
    assert read_tcp_frame(frame + b"next") == (NUMBER, UNIT, b"\x03\x02\x00\x05", len(frame))
    with pytest.raises(ValueError, match="no frame"):
        read_tcp_frame(b"HTTP/1.1 400")
    with pytest.raises(ValueError, match="3 bytes follow a byte count of 2"):
        payload_of(b"\x03\x02\x00\x05\x06")


@pytest.mark.parametrize("noise", [b"", b"\x00\xff", bytes([UNIT]), bytes([UNIT, 3, 1, 0, 0, 0])])
def test_an_answer_on_a_line_is_found_behind_noise(noise: bytes) -> None:
    answer = b"\x17\x04\x00\x01\x00\x02"
    heard = noise + rtu_frame(UNIT, answer)
    assert read_rtu_answer(heard, UNIT) == answer
    assert read_rtu_answer(heard[:-1], UNIT) is None
    assert read_rtu_answer(heard, UNIT + 1) is None
    assert read_rtu_answer(heard[:-1] + b"\x00", UNIT) is None
