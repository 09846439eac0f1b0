"""Frames there and back, read by an independent route, and blocks that cannot be."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.base import DeviceError
from drivers.modbus_blocks import BlockDecoder, unwrap
from rig.model.wire import registers as reg
from rig.model.wire.registers import BlockHeader, Status
from tests.hil_sim.block_samples import unpack_samples
from tests.hil_sim.integrator import seed_rig

RIG = seed_rig()
LAYOUT = reg.block_layout(10, 2)
Codes = np.ndarray
U16 = st.integers(0, 0xFFFF)
STREAMING = Status.STREAMING | Status.BLOCK


def answer(
    header: BlockHeader, measured: Codes | None = None, commands: Codes | None = None
) -> bytes:
    rows = np.zeros((10, 10), int) if measured is None else measured
    outputs = np.zeros((10, 2), int) if commands is None else commands
    return reg.pack_header(header) + reg.pack_samples(rows, outputs)


def block(sequence: int, tick: int) -> BlockHeader:
    return BlockHeader(sequence, tick, STREAMING, 0)


ANSWER_BODY = answer(block(0, 0))


@given(sequence=U16, tick=st.integers(0, 0xFFFF_FFFF), status=st.integers(0, 31), backlog=U16)
def test_a_header_is_ten_bytes_in_the_documented_order(
    sequence: int, tick: int, status: int, backlog: int
) -> None:
    header = BlockHeader(sequence, tick, Status(status), backlog)
    data = reg.pack_header(header)
    words = [sequence, tick >> 16, tick & 0xFFFF, status, backlog]
    assert data == b"".join(word.to_bytes(2, "big") for word in words)
    assert reg.unpack_header(data) == header


@given(
    codes=st.lists(U16, min_size=100, max_size=100),
    outputs=st.lists(st.integers(-32767, 32767), min_size=20, max_size=20),
)
def test_samples_survive_the_wire(codes: list[int], outputs: list[int]) -> None:
    measured, commands = np.reshape(codes, (10, 10)), np.reshape(outputs, (10, 2))
    data = reg.pack_samples(measured, commands)
    flat = struct.unpack(">" + 10 * "10H2h", data)
    assert [flat[12 * k : 12 * k + 10] for k in range(10)] == [tuple(r) for r in measured.tolist()]
    found, put = unpack_samples(data, LAYOUT)
    assert np.array_equal(found, measured)
    assert np.array_equal(put, commands)


@given(channels=st.integers(4, 40), joints=st.integers(1, 9))
def test_a_block_fits_one_modbus_answer(channels: int, joints: int) -> None:
    layout = reg.block_layout(channels, joints)
    assert 1 <= layout.samples <= 10
    assert layout.words <= 125
    assert layout.samples == 10 or layout.words + layout.columns > 125


def test_two_joints_use_an_answer_to_the_last_register() -> None:
    assert (LAYOUT.samples, LAYOUT.words) == (10, 125)


@given(st.lists(st.floats(width=32, allow_nan=False), max_size=20))
def test_floats_are_two_registers_high_word_first(values: list[float]) -> None:
    words = reg.float_words(values)
    data = b"".join(word.to_bytes(2, "big") for word in words)
    assert list(struct.unpack(f">{len(values)}f", data)) == values


@given(near=st.integers(0, 1 << 40), step=st.integers(-(1 << 30), 1 << 30), bits=st.just(32))
def test_unwrapping_finds_the_nearest_number(near: int, step: int, bits: int) -> None:
    assert unwrap((near + step) % (1 << bits), near, bits) == near + step


@given(data=st.binary(max_size=400))
def test_a_block_of_another_size_is_no_block(data: bytes) -> None:
    if len(data) == 240:
        return
    with pytest.raises(ValueError, match=r"reshape|buffer size"):
        BlockDecoder(RIG).decode_samples(block(0, 0), data)


def test_sequence_and_tick_run_on_past_their_registers() -> None:
    decoder = BlockDecoder(RIG)
    decoder.restart(0xFFFF_FFF0)
    blocks = []
    for k in range(70_000):
        header = block(k & 0xFFFF, (0xFFFF_FFF0 + 10 * k) & 0xFFFF_FFFF)
        blocks.append(decoder.decode(header, ANSWER_BODY))
    assert [b.sequence for b in blocks[-2:]] == [69_998, 69_999]
    assert blocks[-1].tick == 0xFFFF_FFF0 + 699_990
    assert decoder.acknowledge == 69_999 & 0xFFFF


def test_dropped_blocks_show_as_a_gap_of_whole_blocks() -> None:
    decoder = BlockDecoder(RIG)
    decoder.decode(block(0, 100), ANSWER_BODY)
    after = decoder.decode(block(5, 150), ANSWER_BODY)
    assert (after.sequence, after.tick) == (5, 150)


@pytest.mark.parametrize(
    "second",
    [
        block(0, 100),  # the same again
        block(0xFFFF, 90),  # an older one
        block(1, 109),  # overlapping
        block(1, 120),  # a gap in time but not in number
        block(3, 110),  # a gap in number but not in time
        block(1, 100 - 0x7000_0000 + (1 << 32)),  # a clock set back
    ],
)
def test_a_block_that_cannot_follow_is_an_error(second: BlockHeader) -> None:
    decoder = BlockDecoder(RIG)
    decoder.decode(block(0, 100), ANSWER_BODY)
    with pytest.raises(DeviceError, match="impossible block"):
        decoder.decode(second, ANSWER_BODY)


def test_the_clock_does_not_go_back_between_two_streams() -> None:
    decoder = BlockDecoder(RIG)
    decoder.decode(block(0, 100), ANSWER_BODY)
    decoder.restart()
    with pytest.raises(DeviceError, match="impossible block"):
        decoder.decode(block(0, 100), ANSWER_BODY)
    assert decoder.decode(block(0, 4000), ANSWER_BODY).tick == 4000


def test_an_output_code_beyond_its_converter_is_an_error() -> None:
    commands = np.zeros((10, 2), int)
    commands[4, 1] = 2048  # 12 bits end at 2047
    with pytest.raises(DeviceError, match="command_2 has the converter code 2048"):
        BlockDecoder(RIG).decode(block(0, 0), answer(block(0, 0), commands=commands))


def test_both_ends_of_the_range_are_saturated() -> None:
    measured = np.full((10, 10), 1)
    measured[2, 3], measured[7, 0] = 0, 0xFFFF
    saturated = BlockDecoder(RIG).decode(block(0, 0), answer(block(0, 0), measured)).saturated
    assert np.argwhere(saturated).tolist() == [[2, 3], [7, 0]]
