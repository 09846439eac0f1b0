"""Convert numbers to and from 16-bit registers, by type and word order.

A register has its high byte first, as in Modbus. A wider number has consecutive registers; `big`
has its high word first, `little` its low word.
"""

from __future__ import annotations

import math
import struct
from enum import StrEnum
from typing import Final


class RegisterType(StrEnum):
    """Type of a number in registers."""

    INT16 = "int16"
    UINT16 = "uint16"
    INT32 = "int32"
    UINT32 = "uint32"
    INT64 = "int64"
    FLOAT32 = "float32"
    FLOAT64 = "float64"


class WordOrder(StrEnum):
    """Which word of a wide number is at the lowest address."""

    BIG = "big"
    LITTLE = "little"


_FORMS: Final = {
    RegisterType.INT16: ">h",
    RegisterType.UINT16: ">H",
    RegisterType.INT32: ">i",
    RegisterType.UINT32: ">I",
    RegisterType.INT64: ">q",
    RegisterType.FLOAT32: ">f",
    RegisterType.FLOAT64: ">d",
}


def integers(form: RegisterType) -> tuple[int, int] | None:
    """Return the least and the largest number of an integer type, None for other types."""
    if form in (RegisterType.FLOAT32, RegisterType.FLOAT64):
        return None
    bits = 8 * struct.calcsize(_FORMS[form])
    signed = _FORMS[form][1].islower()
    return (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if signed else (0, 2**bits - 1)


def word_count(form: RegisterType) -> int:
    """Return the number of registers of a number."""
    return struct.calcsize(_FORMS[form]) // 2


def decode_registers(data: bytes, form: RegisterType, order: WordOrder) -> float:
    """Return the number in the bytes of its registers; int64 is rounded to double precision."""
    if order is WordOrder.LITTLE:
        data = _swapped(data)
    (value,) = struct.unpack(_FORMS[form], data)
    return float(value)


def encode_registers(value: float, form: RegisterType, order: WordOrder) -> list[int]:
    """Return the registers that hold a number, rounded where the type is one of integers.

    Raises ValueError for a number that is not finite or outside the type's range.
    """
    if not math.isfinite(value):
        raise ValueError(f"{value} is no number for a register")
    try:
        data = struct.pack(_FORMS[form], value if integers(form) is None else round(value))
    except (struct.error, OverflowError) as error:
        raise ValueError(f"{value:.6g} is outside the range of {form}") from error
    if order is WordOrder.LITTLE:
        data = _swapped(data)
    return list(struct.unpack(f">{len(data) // 2}H", data))


def _swapped(data: bytes) -> bytes:
    return b"".join(data[i : i + 2] for i in range(len(data) - 2, -1, -2))
