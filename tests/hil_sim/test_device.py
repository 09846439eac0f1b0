"""The device behind the wire, with a clock in hand: streams, laws, uploads, control."""

from __future__ import annotations

from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hil_sim.device.laws import Refused
from rig.model.wire import registers as reg
from rig.model.wire.registers import Refusal, Status
from tests.hil_sim.device_bench import HOST, OTHER, Bench, expect_refusal

# -- streams --------------------------------------------------------------------------------


def test_virtual_time_stands_still_while_nobody_asks(virtual: Bench) -> None:
    virtual.stream()
    virtual.pass_time(5.0)
    assert virtual.device.tick == 0
    virtual.exchange()
    assert virtual.device.tick == 10


def test_a_block_comes_again_until_it_is_acknowledged(virtual: Bench) -> None:
    virtual.stream()
    first, _ = virtual.exchange()
    again, _ = virtual.exchange()
    assert (first.sequence, again.sequence, again.tick) == (0, 0, 0)
    following, _ = virtual.exchange(0)
    assert (following.sequence, following.tick) == (1, 10)
    wrong, _ = virtual.exchange(7)  # never offered: acknowledges nothing
    assert wrong.sequence == 1


def test_real_time_follows_the_clock_whoever_asks(real: Bench) -> None:
    real.stream()
    real.pass_time(0.1)
    assert real.device.tick == 100
    headers = [real.exchange((k - 1) & 0xFFFF)[0] for k in range(10)]
    assert [h.tick for h in headers] == list(range(0, 100, 10))
    assert [h.backlog for h in headers] == list(range(9, -1, -1))
    empty, _ = real.exchange(9)
    assert not empty.status & Status.BLOCK
    assert empty.status & Status.STREAMING


def test_it_sleeps_until_a_block_is_due(real: Bench) -> None:
    assert real.device.idle_seconds() == pytest.approx(0.010)
    real.now += 0.0035
    assert real.device.idle_seconds() == pytest.approx(0.0065)
    real.now += 1.0
    assert real.device.idle_seconds() == 0.0


def test_a_full_queue_drops_the_oldest_and_the_numbers_show_it(real: Bench) -> None:
    real.stream()
    real.exchange()
    real.write(reg.CONTROL_WATCHDOG, 10_000)
    real.pass_time(5.0)
    header, _ = real.exchange(0)
    # 5 s make 500 blocks, the queue holds 4 s.
    assert real.status(reg.STATUS_DROPPED) == 100
    assert (header.sequence, header.tick, header.backlog) == (100, 1000, 399)


def test_a_machine_that_slept_pauses_the_clock_instead_of_racing(real: Bench) -> None:
    real.now += 3600.0
    real.device.poll()
    assert real.device.tick == 4000
    real.pass_time(0.1)
    assert real.device.tick == 4100


def test_a_new_stream_is_numbered_anew_and_restarts_waveforms(virtual: Bench) -> None:
    upload(virtual, 1, np.arange(100, dtype=np.int16) * 100)
    virtual.law(1, gain=1.0, limit=5.0)
    virtual.write(reg.CONTROL_APPLY, reg.APPLY)
    virtual.stream()
    virtual.exchange()
    virtual.exchange(0)
    virtual.stream()
    header, commands = virtual.exchange()
    assert (header.sequence, header.tick) == (0, 20)
    wanted = np.rint(np.arange(10) * 100 * (10 / 32767) * 2047 / 10)
    assert commands[:, 0].tolist() == wanted.tolist()


# -- laws -----------------------------------------------------------------------------------


def test_staged_laws_do_nothing_until_all_are_applied_at_one_tick(virtual: Bench) -> None:
    virtual.stream()
    virtual.law(1, bias=1.0, limit=5.0)
    virtual.law(2, bias=-1.0, limit=5.0)
    _, commands = virtual.exchange()
    assert not commands.any()
    virtual.write(reg.CONTROL_APPLY, reg.APPLY)
    assert virtual.status(reg.STATUS_APPLY_TICK) == 10
    header, commands = virtual.exchange(0)
    assert header.tick == 10
    assert np.all(commands == [205, -205])  # 1 V on 12 bits over +-10 V


def test_in_real_time_a_law_acts_from_the_next_sample_on(real: Bench) -> None:
    real.stream()
    real.now += 0.0137
    real.drive(1.0)
    assert real.status(reg.STATUS_APPLY_TICK) == 13
    real.now += 0.0103
    _, first = real.exchange()
    _, second = real.exchange(0)
    put = np.concatenate([first, second])[:, 0]
    assert put.tolist() == [0] * 13 + [205] * 7


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_law_that_is_no_number_is_refused(virtual: Bench, value: float) -> None:
    for name in reg.LAW_FIELDS:
        expect_refusal(Refusal.NOT_FINITE, virtual.law, 2, **{name: value})
    assert virtual.status(reg.STATUS_REFUSAL_JOINT) == 2
    assert virtual.status(reg.STATUS_REFUSAL) == Refusal.NOT_FINITE


def test_the_edges_of_every_range_are_allowed_and_no_more(virtual: Bench) -> None:
    edges = {"gain": 100.0, "bias": 10.0, "position_gain": 1e5, "setpoint": 0.04, "limit": 10.0}
    for name, edge in edges.items():
        virtual.law(1, **{name: edge})
        expect_refusal(Refusal.OUT_OF_RANGE, virtual.law, 1, **{name: 1.001 * edge})
    virtual.law(1, bias=-10.0)
    expect_refusal(Refusal.OUT_OF_RANGE, virtual.law, 1, limit=-0.001)


def test_half_a_number_is_not_written(virtual: Bench) -> None:
    expect_refusal(
        Refusal.NO_SUCH_REGISTER, virtual.map.write, HOST, reg.LAWS.address + 1, bytes(4)
    )
    expect_refusal(Refusal.NO_SUCH_REGISTER, virtual.map.write, HOST, reg.LAWS.address, bytes(6))
    third_joint = reg.LAWS.address + 2 * reg.LAW_WORDS
    expect_refusal(Refusal.NO_SUCH_REGISTER, virtual.map.write, HOST, third_joint, bytes(4))


@given(address=st.integers(0, 0x0400), data=st.binary(max_size=60))
def test_no_write_whatever_breaks_the_device(address: int, data: bytes) -> None:
    bench = Bench(realtime=False)
    data = data[: len(data) // 2 * 2]
    with suppress(Refused):
        bench.map.write(HOST, address, data)
    bench.write(reg.CONTROL_ZERO, 1)
    bench.write(reg.CONTROL_STREAM, 1)
    assert not bench.exchange()[1].any()


@given(address=st.integers(0, 0x0400), count=st.integers(0, 130))
def test_a_read_is_whole_or_refused(address: int, count: int) -> None:
    bench = Bench(realtime=False)
    answer = bytes(2 * count)
    with suppress(Refused):
        answer = bench.map.read(OTHER, address, count)
    assert len(answer) == 2 * count
    assert bench.device.tick == 0  # a bystander's reading moves nothing


# -- uploads --------------------------------------------------------------------------------


def page(bench: Bench, offset: int, codes: np.ndarray) -> None:
    words = [offset >> 16, offset & 0xFFFF, *codes.astype(np.int16).view(np.uint16).tolist()]
    bench.write(reg.UPLOAD_OFFSET, *words)


def upload(bench: Bench, joint: int, codes: np.ndarray, checksum: int | None = None) -> None:
    bench.write(reg.UPLOAD_JOINT, joint, len(codes) >> 16, len(codes) & 0xFFFF)
    for first in range(0, len(codes), 100):
        page(bench, first, codes[first : first + 100])
    total = reg.wave_checksum(codes) if checksum is None else checksum
    bench.write(reg.UPLOAD_COMMIT, total >> 16, total & 0xFFFF)


def played(bench: Bench, samples: int) -> list[int]:
    bench.law(1, gain=1.0, limit=10.0)
    bench.write(reg.CONTROL_APPLY, reg.APPLY_AND_RESTART)
    bench.stream()
    blocks = [bench.exchange((k - 1) & 0xFFFF)[1][:, 0] for k in range(samples // 10)]
    return [int(code) for code in np.concatenate(blocks)]


def test_an_upload_is_played_over_and_over(virtual: Bench) -> None:
    codes = (np.arange(30) * 160).astype(np.int16)
    upload(virtual, 1, codes)
    wanted = np.rint(codes * (2047 / 32767)).tolist()
    assert played(virtual, 90) == 3 * wanted


def test_a_torn_upload_is_never_played(virtual: Bench) -> None:
    good = np.full(20, 16_000, dtype=np.int16)
    upload(virtual, 1, good)
    bad = np.full(250, -16_000, dtype=np.int16)
    # Another checksum; a page missing; no beginning: all are thrown away.
    expect_refusal(Refusal.UPLOAD_TORN, upload, virtual, 1, bad, checksum=1)
    virtual.write(reg.UPLOAD_JOINT, 1, 0, 250)
    page(virtual, 100, bad[100:200])
    total = reg.wave_checksum(bad)
    commit = (reg.UPLOAD_COMMIT, total >> 16, total & 0xFFFF)
    expect_refusal(Refusal.UPLOAD_TORN, virtual.write, *commit)
    expect_refusal(Refusal.UPLOAD_TORN, virtual.write, *commit)
    expect_refusal(Refusal.UPLOAD_TORN, page, virtual, 0, bad[:100])
    # Even where the missing page would have been zeros, so that the checksum holds.
    bad[100:] = 0
    total = reg.wave_checksum(bad)
    virtual.write(reg.UPLOAD_JOINT, 1, 0, 250)
    page(virtual, 0, bad[:100])
    commit = (reg.UPLOAD_COMMIT, total >> 16, total & 0xFFFF)
    expect_refusal(Refusal.UPLOAD_TORN, virtual.write, *commit)
    assert set(played(virtual, 20)) == {round(16_000 * 2047 / 32767)}


def test_pages_and_lengths_beyond_the_end_are_refused(virtual: Bench) -> None:
    expect_refusal(Refusal.OUT_OF_RANGE, virtual.write, reg.UPLOAD_JOINT, 3, 0, 10)
    expect_refusal(Refusal.OUT_OF_RANGE, virtual.write, reg.UPLOAD_JOINT, 1, 0, 0)
    expect_refusal(Refusal.OUT_OF_RANGE, virtual.write, reg.UPLOAD_JOINT, 1, 2, 1)
    virtual.write(reg.UPLOAD_JOINT, 1, 0, 10)
    expect_refusal(Refusal.OUT_OF_RANGE, page, virtual, 5, np.zeros(6))


def test_a_new_waveform_waits_for_apply(virtual: Bench) -> None:
    upload(virtual, 1, np.full(10, 16_000, dtype=np.int16))
    assert set(played(virtual, 20)) == {1000}
    upload(virtual, 1, np.full(10, 8_000, dtype=np.int16))
    assert set(virtual.exchange(1)[1][:, 0]) == {1000}
    virtual.write(reg.CONTROL_APPLY, reg.APPLY)
    assert set(virtual.exchange(2)[1][:, 0]) == {500}
