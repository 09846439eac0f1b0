"""Registers to numbers and back, against `struct` and written-out examples."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.register_types import (
    RegisterType,
    WordOrder,
    decode_registers,
    encode_registers,
    word_count,
)

INTEGERS = {
    RegisterType.INT16: ("h", 16, True),
    RegisterType.UINT16: ("H", 16, False),
    RegisterType.INT32: ("i", 32, True),
    RegisterType.UINT32: ("I", 32, False),
    RegisterType.INT64: ("q", 64, True),
}
FLOATS = {RegisterType.FLOAT32: ("f", 32), RegisterType.FLOAT64: ("d", 64)}


def in_order(data: bytes, order: WordOrder) -> bytes:
    """The bytes as they stand on the wire: big-endian words, the words in their order."""
    words = struct.unpack(f">{len(data) // 2}H", data)
    return struct.pack(f">{len(words)}H", *(words if order == "big" else reversed(words)))


@given(st.sampled_from(list(INTEGERS)), st.sampled_from(list(WordOrder)), st.data())
def test_integers_are_what_struct_says(
    form: RegisterType, order: WordOrder, data: st.DataObject
) -> None:
    letter, bits, signed = INTEGERS[form]
    low, high = (-(1 << (bits - 1)), (1 << (bits - 1)) - 1) if signed else (0, (1 << bits) - 1)
    number = data.draw(st.integers(low, high))
    wire = in_order(struct.pack(f">{letter}", number), order)
    assert len(wire) == 2 * word_count(form)
    assert decode_registers(wire, form, order) == float(number)
    if abs(number) < 2**53:
        assert struct.pack(f">{len(wire) // 2}H", *encode_registers(number, form, order)) == wire


@given(
    st.sampled_from(list(FLOATS)),
    st.sampled_from(list(WordOrder)),
    st.floats(allow_nan=False, allow_infinity=False, width=32),
)
def test_floats_are_what_struct_says(form: RegisterType, order: WordOrder, number: float) -> None:
    wire = in_order(struct.pack(f">{FLOATS[form][0]}", number), order)
    assert decode_registers(wire, form, order) == number
    words = encode_registers(number, form, order)
    assert struct.pack(f">{len(words)}H", *words) == wire


@given(st.sampled_from(list(RegisterType)), st.sampled_from(list(WordOrder)), st.data())
def test_no_bytes_are_an_error(form: RegisterType, order: WordOrder, data: st.DataObject) -> None:
    raw = data.draw(st.binary(min_size=2 * word_count(form), max_size=2 * word_count(form)))
    assert isinstance(decode_registers(raw, form, order), float)


def test_examples_written_out() -> None:
    one = bytes.fromhex("3f800000")
    assert decode_registers(one, RegisterType.FLOAT32, WordOrder.BIG) == 1.0
    swapped = bytes.fromhex("00003f80")
    assert decode_registers(swapped, RegisterType.FLOAT32, WordOrder.LITTLE) == 1.0
    assert encode_registers(-2.0, RegisterType.INT16, WordOrder.BIG) == [0xFFFE]
    assert encode_registers(65536.0, RegisterType.UINT32, WordOrder.BIG) == [1, 0]
    assert encode_registers(65536.0, RegisterType.UINT32, WordOrder.LITTLE) == [0, 1]
    assert encode_registers(0.6, RegisterType.INT16, WordOrder.BIG) == [1]


@pytest.mark.parametrize(
    ("value", "form"),
    [
        (32767.6, RegisterType.INT16),
        (-1.0, RegisterType.UINT16),
        (1e39, RegisterType.FLOAT32),
        (float("nan"), RegisterType.FLOAT32),
        (float("inf"), RegisterType.INT16),
    ],
)
def test_numbers_that_do_not_fit_are_refused(value: float, form: RegisterType) -> None:
    with pytest.raises(ValueError, match=r"outside the range of|is no number"):
        encode_registers(value, form, WordOrder.BIG)
