"""Frames of a serial line: there and back, cut anywhere, damaged in every way."""

from __future__ import annotations

import random
import zlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.model.wire.frames import (
    MAX_ENCODED,
    MAX_PAYLOAD,
    FrameDecoder,
    WireFrame,
    encode_frame,
)

FUZZED = 120_000

frames = st.builds(
    WireFrame,
    type=st.integers(0, 0xFF),
    number=st.integers(0, 0xFFFF),
    session=st.integers(0, 0xFFFF_FFFF),
    payload=st.binary(max_size=MAX_PAYLOAD)
    | st.integers(0, MAX_PAYLOAD).map(bytes)
    | st.integers(0, MAX_PAYLOAD).map(lambda n: b"\x01" * n),
    version=st.integers(0, 0xFF),
)


def unstuffed(data: bytes) -> bytes:
    """COBS by its definition: each code byte counts to the next zero of the content."""
    content = bytearray()
    while data:
        code, data = data[0], data[1:]
        content += data[: code - 1]
        data = data[code - 1 :]
        if code < 0xFF and data:
            content.append(0)
    return bytes(content)


@given(frames)
def test_a_frame_stands_on_the_wire_as_documented(frame: WireFrame) -> None:
    wire = encode_frame(frame)
    assert (wire[0], wire[-1], wire.count(0)) == (0, 0, 2)
    body = unstuffed(wire[1:-1])
    assert body[:2] == bytes([frame.version, frame.type])
    assert body[2:8] == frame.number.to_bytes(2, "big") + frame.session.to_bytes(4, "big")
    assert body[8:-4] == frame.payload
    assert body[-4:] == zlib.crc32(body[:-4]).to_bytes(4, "big")
    assert len(wire) <= MAX_ENCODED + 2


@given(st.lists(frames, max_size=6), st.lists(st.integers(1, 300), max_size=20), st.binary())
def test_frames_come_back_however_the_bytes_are_cut(
    sent: list[WireFrame], cuts: list[int], noise: bytes
) -> None:
    wire = noise.replace(b"\0", b"") + b"".join(map(encode_frame, sent))
    decoder, found = FrameDecoder(), []
    for size in cuts:
        found += decoder.feed(wire[:size])
        wire = wire[size:]
    found += decoder.feed(wire)
    assert found == sent


@given(frames, st.data())
def test_flipped_bits_never_make_another_frame(frame: WireFrame, data: st.DataObject) -> None:
    wire = bytearray(encode_frame(frame))
    for _ in range(data.draw(st.integers(1, 8))):
        bit = data.draw(st.integers(0, 8 * len(wire) - 1))
        wire[bit // 8] ^= 1 << bit % 8
    assert set(FrameDecoder().feed(bytes(wire) + b"\0")) <= {frame}


@given(st.lists(st.binary(max_size=2000)))
def test_noise_is_no_frame_and_takes_no_memory(noise: list[bytes]) -> None:
    decoder = FrameDecoder()
    for data in noise:
        assert decoder.feed(data) == []
        assert len(decoder._partial) <= MAX_ENCODED
    whole = WireFrame(1, 2, 3, b"after noise")
    assert decoder.feed(encode_frame(whole)) == [whole]
    assert decoder.received == sum(map(len, noise)) + len(encode_frame(whole))


def test_a_line_without_zeros_counts_as_one_damaged_frame() -> None:
    decoder = FrameDecoder()
    for _ in range(1000):
        assert decoder.feed(b"\x55" * 100) == []
    assert decoder.damaged == 1
    whole = encode_frame(WireFrame(1, 2, 3))
    assert len(decoder.feed(whole + whole)) == 2
    assert decoder.damaged == 1


def test_what_does_not_fit_is_not_sent() -> None:
    with pytest.raises(ValueError, match="253 bytes; 252"):
        encode_frame(WireFrame(1, 2, 3, bytes(253)))


def test_a_torn_frame_is_counted_and_the_next_one_is_found() -> None:
    decoder = FrameDecoder()
    wire = encode_frame(WireFrame(1, 2, 3, b"abcdef"))
    assert decoder.feed(wire[:10]) == []
    assert decoder.feed(wire) == [WireFrame(1, 2, 3, b"abcdef")]
    assert decoder.damaged == 1
    decoder.feed(wire[:10])
    decoder.reset()
    assert decoder.feed(wire) == [WireFrame(1, 2, 3, b"abcdef")]
    assert decoder.damaged == 1


def test_damaged_frames_by_the_hundred_thousand() -> None:
    """Frames flipped, cut, doubled, merged and shuffled: only whole ones come through."""
    rng = random.Random(20)
    decoder, sent, found, whole = FrameDecoder(), set(), [], 0
    for index in range(FUZZED):
        payload = rng.randbytes(rng.randrange(0, 40))
        frame = WireFrame(rng.randrange(256), index & 0xFFFF, index, payload)
        sent.add(frame)
        wire = bytearray(encode_frame(frame))
        fault = rng.randrange(8)
        if fault == 0:
            wire[rng.randrange(len(wire))] ^= 1 << rng.randrange(8)
        elif fault == 1:
            del wire[rng.randrange(len(wire)) :]
        elif fault == 2:
            del wire[rng.randrange(1, len(wire))]
        elif fault == 3:
            position = rng.randrange(len(wire))
            wire[position:position] = rng.randbytes(3)
        elif fault == 4:
            start = rng.randrange(len(wire))
            wire += wire[start:]
        else:
            whole += 1
        found += decoder.feed(bytes(wire))
    assert set(found) <= sent
    # Each whole one but those whose leading zero could not part them from what came before.
    assert len(set(found)) >= whole
    assert decoder.damaged > FUZZED // 4
