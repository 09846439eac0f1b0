"""Damage to bytes: what wires, disks and editors do to frames and files, by a seed."""

from __future__ import annotations

import random
from collections.abc import Sequence
from typing import Final

_EDGES: Final = (b"\0", b"\xff", b"\x7f", b"\x80", b"\xff\xff", b"\0\0", b"\x00\x01", b"\n", b": ")
_TOKENS: Final = (
    b"nan", b"-1", b"1e999", b"[]", b"{}", b"null", b"&a", b"*a", b"!!python/object", b"  ", b"\t",
    b"'", b'"', b"|", b"9" * 400, b"m", b"MPa", b"- ", b"#",
)  # fmt: skip


def damaged(rng: random.Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Return `data` with one to four kinds of damage; pieces of `others` may be put in."""
    for _ in range(rng.choice((1, 1, 1, 2, 3, 4))):
        at = rng.randrange(len(data) + 1)
        end = min(len(data), at + rng.choice((1, 1, 2, 4, 8, 64)))
        kind = rng.randrange(8)
        if kind == 0 and data:
            place = rng.randrange(len(data))
            turned = data[place] ^ 1 << rng.randrange(8)
            data = data[:place] + bytes([turned]) + data[place + 1 :]
        elif kind == 1:
            data = data[:at]
        elif kind == 2:
            data = data[:at] + data[end:]
        elif kind == 3:
            data = data[:at] + data[at:end] * rng.choice((2, 2, 3, 50)) + data[end:]
        elif kind == 4:
            data = data[:at] + rng.randbytes(rng.choice((1, 2, 8, 64))) + data[end:]
        elif kind == 5:
            data = data[:at] + rng.choice(_EDGES) + data[end:]
        elif kind == 6:
            data = data[:at] + rng.choice(_TOKENS) + data[end:]
        else:
            other = rng.choice(others)
            cut = rng.randrange(len(other) + 1)
            data = data[:at] + other[cut : cut + 200] + data[end:]
    return data
