"""A plain I/O module in a process of its own, driven through a rig file and nothing else."""

from __future__ import annotations

import logging
import re
import socket
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import closing, suppress
from importlib.metadata import EntryPoint, EntryPoints
from importlib.resources import files
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from drivers import make_driver, registry, wire_at
from drivers.base import OFF, DeviceError, DeviceLost, OutputLaw
from drivers.bench_protocol import DeviceSilent
from drivers.modbus_map import MapSettings, ModbusMapDriver, UnitConnection, register_map, spans
from rig.bench.session import Bench
from rig.model.parse import InputError, parse_model
from rig.model.rig import Rig
from rig.runs.recorder import Recorder
from rig.runs.store import load_run
from tests.cli.bench import bramah_here
from tests.drivers.plain_module import SPEED_PER_VOLT, STEP, WIRE, module_process
from tests.drivers.polled_bench import FakeClock

COLUMN = {
    "spool_1": 0,
    "piston_1": 1,
    "cap_pressure_1": 2,
    "rod_pressure_1": 3,
    "spool_2": 4,
    "piston_2": 5,
    "cap_pressure_2": 6,
    "rod_pressure_2": 7,
    "supply_pressure": 8,
    "oil_temperature": 9,
    "command_1": 10,
    "command_2": 11,
}


def rig_text(wire: str) -> str:
    """The shipped two-joint rig's file at 100 Hz with another section `wire`."""
    text = (files("rig") / "shipped" / "shinshu-2dof.yaml").read_text("utf-8")
    text = re.sub(r"^wire:.*$", lambda _: wire, text, flags=re.MULTILINE)
    return text.replace("sample_rate: 1 kHz", "sample_rate: 100 Hz")


def rig_of(port: int = 502, change: tuple[str, str] | None = None) -> Rig:
    wire = WIRE.format(port=port)
    if change is not None:
        assert change[0] in wire
        wire = wire.replace(*change)
    return parse_model(Rig, rig_text(wire), "plain.yaml")


def in_fake_time(rig: Rig) -> ModbusMapDriver:
    clock = FakeClock()
    return ModbusMapDriver(rig.wire, rig, clock=clock, sleep=clock.sleep)


def put_out(port: int) -> list[float]:
    """The voltages that the module really puts out, asked over a connection of our own."""
    with closing(socket.create_connection(("127.0.0.1", port), 10)) as wire:
        wire.sendall(bytes.fromhex("002a 0000 0006 07 03 00d2 0002"))
        answer = b""
        while len(answer) < 13:
            answer += wire.recv(64)
    return [1e-3 * mv for mv in struct.unpack(">hh", answer[9:13])]


def put_into(port: int, register: int, value: int) -> None:
    """Write a register over a connection of our own, as another program may."""
    with closing(socket.create_connection(("127.0.0.1", port), 10)) as wire:
        wire.sendall(struct.pack(">HHHBBHH", 9, 0, 6, 7, 6, register, value))
        assert len(wire.recv(64)) == 12


def delay_next_answer(port: int, milliseconds: int) -> None:
    put_into(port, 300, milliseconds)


@pytest.fixture(scope="module")
def port() -> Iterator[int]:
    with module_process() as (_, port):
        yield port


@pytest.fixture
def driver(port: int) -> Iterator[ModbusMapDriver]:
    driver = in_fake_time(rig_of(port))
    driver.connect()
    yield driver
    driver.close()


def test_a_rig_file_alone_makes_every_channel_si(driver: ModbusMapDriver, port: int) -> None:
    driver.start()
    data = driver.read_block().data
    for name, value in {
        "cap_pressure_1": 2.0e6,
        "rod_pressure_1": 1.55e6,
        "cap_pressure_2": 2.0e6,
        "rod_pressure_2": 1.55e6,
        "supply_pressure": 7.0e6,
        "oil_temperature": 40.0,
        "command_1": 0.0,
    }.items():
        assert data[:, COLUMN[name]] == pytest.approx(value, rel=1e-6), name


def test_the_map_is_read_in_as_few_requests_as_possible() -> None:
    rig = rig_of()
    found = register_map(MapSettings.of(rig.wire), rig)
    assert [(s.function, s.address, s.words) for s in spans(found.inputs)] == [
        (3, 0, 6),
        (4, 10, 9),
    ]
    assert [(s.function, s.address, s.words) for s in spans(found.outputs)] == [(3, 100, 2)]
    assert [s.words for s in spans(found.inputs, 4)] == [4, 2, 3, 3, 3]
    assert str(spans(found.outputs)[0]) == "registers 100 to 101 (output 1 output 2)"


def test_a_waveform_is_played_and_moves_the_piston(driver: ModbusMapDriver, port: int) -> None:
    driver.start()
    driver.upload(1, 2.0 * np.sin(2 * np.pi * np.arange(40) / 40))
    driver.read_block()
    tick = driver.apply([OFF, OutputLaw(gain=0.5, bias=0.1, limit=0.9)], restart=True)
    blocks = [driver.read_block() for _ in range(16)]
    assert [block.tick for block in blocks] == [tick + 5 * k for k in range(16)]
    data = np.vstack([block.data for block in blocks])
    played = np.clip(np.sin(2 * np.pi * np.arange(80) / 40) + 0.1, -0.9, 0.9)
    assert data[:, COLUMN["command_2"]] == pytest.approx(played)
    # Registers hold steps of 5 mV, 1 mV and 1 um.
    assert put_out(port)[1] == pytest.approx(played[-1], abs=3e-3)
    assert data[1:, COLUMN["spool_2"]] == pytest.approx(0.1 * played[:-1], abs=1e-3)
    moved = SPEED_PER_VOLT * STEP * np.concatenate([[0.0], np.cumsum(played[:-1])])
    piston = data[:, COLUMN["piston_2"]]
    assert piston - piston[0] == pytest.approx(moved, abs=80 * SPEED_PER_VOLT * STEP * 2.5e-3)


def test_a_lock_law_pulls_the_piston_to_its_place(driver: ModbusMapDriver, port: int) -> None:
    driver.start()
    law = OutputLaw(position_gain=400.0, setpoint=0.004, limit=2.0)
    driver.apply([law, OFF], restart=True)
    data = np.vstack([driver.read_block().data for _ in range(40)])
    assert data[-20:, COLUMN["piston_1"]] == pytest.approx(0.004, abs=2e-5)
    expected = np.clip(400.0 * (0.004 - data[:, COLUMN["piston_1"]]), -2.0, 2.0)
    assert data[:, COLUMN["command_1"]] == pytest.approx(expected)


def test_zeroing_reaches_the_module_at_once(driver: ModbusMapDriver, port: int) -> None:
    driver.start()
    driver.apply([OutputLaw(bias=1.5, limit=2.0), OutputLaw(bias=-1.0, limit=2.0)])
    driver.read_block()
    assert put_out(port) == pytest.approx([1.5, -1.0])
    driver.zero_outputs()
    assert put_out(port) == [0.0, 0.0]
    driver.read_block()
    assert put_out(port) == [0.0, 0.0]


def test_a_host_that_vanishes_leaves_the_zeroing_to_the_modules_watchdog(port: int) -> None:
    driver = in_fake_time(rig_of(port, ("milliseconds: 1500", "milliseconds: 300")))
    driver.connect()
    driver.start()
    driver.apply([OutputLaw(bias=1.0, limit=2.0), OFF])
    driver.read_block()
    deadline = time.monotonic() + 30.0
    while put_out(port) != [0.0, 0.0] and time.monotonic() < deadline:
        time.sleep(0.05)
    assert put_out(port) == [0.0, 0.0]
    driver.close()


WRONG_WATCHDOG = ("watchdog_register: 200", "watchdog_register: 210")  # reads back as 0


def test_outputs_are_zeroed_although_the_watchdog_cannot_be_set(
    port: int, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A host that hung has left 2.5 V at a valve; the module has a new firmware."""
    put_into(port, 100, 500)
    assert put_out(port) == [2.5, 0.0]
    driver = in_fake_time(rig_of(port, WRONG_WATCHDOG))
    driver.zero_outputs()
    assert put_out(port) == [0.0, 0.0]
    assert "the outputs are at zero, but the device cannot be used: register 210" in caplog.text
    with pytest.raises(DeviceError, match="register 210"):
        driver.connect()
    put_into(port, 101, 500)
    rig = tmp_path / "rig.yaml"
    rig.write_text(rig_text(WIRE.format(port=port).replace(*WRONG_WATCHDOG)))
    stopped = bramah_here("stop", "--rig", rig)
    assert stopped.returncode == 0, stopped.stderr
    assert stopped.stdout.startswith("outputs at zero, confirmed by the device")
    assert put_out(port) == [0.0, 0.0]


def test_an_output_that_is_acknowledged_and_kept_is_not_confirmed_at_zero(
    port: int, tmp_path: Path
) -> None:
    rig = tmp_path / "rig.yaml"
    rig.write_text(rig_text(WIRE.format(port=port)))
    for register, value in ((200, 0), (100, 500), (302, 1)):  # the watchdog would zero it
        put_into(port, register, value)
    try:
        with pytest.raises(DeviceError, match=r"output 1 .* holds 2.5 V after 0 V was written"):
            in_fake_time(rig_of(port)).connect()
        stopped = bramah_here("stop", "--rig", rig)
    finally:
        put_into(port, 302, 0)
    assert stopped.returncode == 4
    assert stopped.stderr.startswith("bramah: outputs not confirmed at zero")
    assert "output 1 of the I/O module" in stopped.stderr
    assert "confirmed by the device" not in stopped.stdout
    assert bramah_here("stop", "--rig", rig).returncode == 0
    assert put_out(port) == [0.0, 0.0]


def test_a_module_that_does_not_read_its_outputs_back_is_named_once(
    driver: ModbusMapDriver, port: int, caplog: pytest.LogCaptureFixture
) -> None:
    put_into(port, 303, 1)
    try:
        for _ in range(2):
            driver.zero_outputs()
    finally:
        put_into(port, 303, 0)
    said = [r.message for r in caplog.records if "does not read its outputs back" in r.message]
    assert len(said) == 1
    assert "registers 100 to 101 (output 1 output 2)" in said[0]


def test_a_module_that_is_busy_for_a_moment_is_asked_again(
    driver: ModbusMapDriver, port: int
) -> None:
    driver.start()
    driver.apply([OutputLaw(bias=1.0, limit=2.0), OFF])
    driver.read_block()
    put_into(port, 301, 8)
    assert driver.read_block().data[-1, COLUMN["command_1"]] == 1.0
    put_into(port, 301, 8)
    driver.zero_outputs()
    assert put_out(port) == [0.0, 0.0]


def test_a_run_zeroes_a_module_that_refuses_for_longer_than_an_answer_takes(
    port: int, caplog: pytest.LogCaptureFixture
) -> None:
    """The module has no watchdog: nothing but the host zeroes its outputs."""
    alone = "zero_by: none\n  accept_no_watchdog: true"
    rig = rig_of(port, (NO_WATCHDOG[0], alone))
    rig = rig.model_copy(update={"wire": rig.wire.model_copy(update={"timeout": 0.2})})
    with Bench(rig, in_fake_time(rig), signals=False) as bench:
        bench.exchange()
        put_into(port, 100, 500)
        put_into(port, 301, 40)  # each is asked again after 10 ms
        assert bench.zero_outputs()
        assert put_out(port) == [0.0, 0.0]
        put_into(port, 301, 1_000)
        caplog.clear()
        assert not bench.zero_outputs()
        assert "this device has no watchdog: NOTHING ELSE zeroes its outputs" in caplog.text
        put_into(port, 301, 0)


def test_in_real_time_blocks_come_in_order_and_the_clock_is_kept(port: int) -> None:
    rig = rig_of(port).model_copy(update={"sample_rate": 20.0})
    driver = ModbusMapDriver(rig.wire, rig)
    info = driver.connect()
    assert info.identity == f"I/O module at 127.0.0.1:{port}, unit 7"
    assert not info.virtual_time
    driver.start()
    blocks = [driver.read_block() for _ in range(6)]
    driver.close()
    assert blocks[0].sequence == 0
    for one, other in pairwise(blocks):
        missing = other.tick - one.tick - len(one.data)
        assert missing >= 0
        assert other.sequence - one.sequence == (2 if missing else 1)  # a late host shows as a gap
    read_at = np.concatenate([block.read_at for block in blocks if block.read_at is not None])
    ticks = np.concatenate([np.arange(b.tick, b.tick + len(b.data)) for b in blocks])
    own = np.isfinite(read_at)
    assert np.all(read_at[own] >= ticks[own] / 20.0)


def test_a_bench_locks_and_excites_over_it(port: int, tmp_path: Path) -> None:
    rig = rig_of(port)
    clock = FakeClock()
    driver = ModbusMapDriver(rig.wire, rig, clock=clock, sleep=clock.sleep)
    recorder = Recorder(tmp_path / "run", rig)
    with Bench(rig, driver, recorder, clock=clock, signals=False) as bench:
        bench.upload(1, np.sin(2 * np.pi * np.arange(50) / 50))
        laws = [
            OutputLaw(position_gain=300.0, setpoint=0.002, limit=2.0),
            OutputLaw(gain=0.5, limit=1.0),
        ]
        first = bench.apply(laws, restart=True)
        with bench.record(step="lock-1", start_tick=first, ticks=100):
            data = bench.run_for(1.0)
    assert data.shape == (100, 12)
    assert bench.lost_samples == 0
    assert data[-10:, COLUMN["piston_1"]] == pytest.approx(0.002, abs=5e-5)
    run = load_run(tmp_path / "run")
    kept = register_map(MapSettings.of(run.rig.wire), run.rig)
    assert kept == register_map(MapSettings.of(rig.wire), rig)
    (record,) = run.records
    played = 0.5 * np.sin(2 * np.pi * np.arange(100) / 50)
    assert record.channels["command_2"] == pytest.approx(played)
    assert put_out(port) == [0.0, 0.0]


# -- what goes wrong on the wire ------------------------------------------------------------


def test_a_module_that_dies_is_a_lost_device() -> None:
    with module_process() as (process, port):
        driver = in_fake_time(rig_of(port))
        driver.connect()
        driver.start()
        driver.read_block()
        process.kill()
        process.wait(10)
        with pytest.raises(DeviceLost, match=rf"127.0.0.1:{port}"):
            driver.read_block()
        with pytest.raises(DeviceLost, match="nothing answers"):
            driver.zero_outputs()
        driver.close()


def test_after_a_timeout_the_late_answer_reaches_nobody(port: int) -> None:
    rig = rig_of(port, ("timeout: 5 s", "timeout: 0.3 s"))
    driver = in_fake_time(rig)
    driver.connect()
    driver.start()
    driver.apply([OutputLaw(bias=1.0, limit=2.0), OFF])
    driver.read_block()
    delay_next_answer(port, 1200)
    with pytest.raises(DeviceLost, match=r"does not answer \(0.3 s\)"):
        driver.read_block()
    with pytest.raises(DeviceLost, match="is closed"):
        driver.read_block()
    driver.zero_outputs()
    assert put_out(port) == [0.0, 0.0]
    driver.start()
    assert driver.read_block().data[:, COLUMN["oil_temperature"]] == pytest.approx(40.0)
    driver.close()


class Answers:
    """A listener that answers the first requests by the bytes a function of each returns."""

    def __init__(self, *answers) -> None:  # type: ignore[no-untyped-def]
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._listener.settimeout(20)
        self.port: int = self._listener.getsockname()[1]
        self._answers = answers
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        with closing(self._listener), closing(self._listener.accept()[0]) as wire:
            self.wire = wire
            wire.settimeout(20)
            with suppress(ConnectionError):  # the host may close with answers unread
                for answer in self._answers:
                    wire.sendall(answer(wire.recv(300)))
                wire.recv(1)  # until the host closes

    def join(self) -> None:
        self._thread.join(20)


def words(number: int, values: list[int], function: int = 3) -> bytes:
    body = struct.pack(f">BBB{len(values)}H", 7, function, 2 * len(values), *values)
    return struct.pack(">HHH", number, 0, len(body)) + body


def numbered(request: bytes) -> int:
    return int.from_bytes(request[:2], "big")


def fetched(*answers) -> bytes:  # type: ignore[no-untyped-def]
    server = Answers(*answers)
    link = UnitConnection("127.0.0.1", server.port, 0.5, unit=7)
    link.open()
    try:
        for _ in answers[1:]:
            link.read(0, 2)
        return link.read(0, 2)
    finally:
        link.close()
        server.join()


def test_an_answer_with_another_transaction_number_is_not_taken() -> None:
    def late_and_right(request: bytes) -> bytes:
        stale = words(numbered(request) + 7, [111, 111])
        return stale + words(numbered(request), [5, 6])

    assert fetched(late_and_right) == bytes.fromhex("0005 0006")
    for number in (0, 2, 0xFFFF):  # the request has number 1
        with pytest.raises(DeviceSilent, match=r"does not answer \(0.5 s\)"):
            fetched(lambda _, number=number: words(number, [111, 111]))


def test_answers_to_others_without_a_pause_end_the_request_in_time(
    caplog: pytest.LogCaptureFixture,
) -> None:
    def without_a_pause(request: bytes) -> bytes:
        began = time.monotonic()
        with suppress(OSError):  # the host closes
            while time.monotonic() < began + 20.0:
                server.wire.sendall(50 * words(numbered(request) + 7, [111, 111]))
        return b""

    server = Answers(without_a_pause)
    link = UnitConnection("127.0.0.1", server.port, 0.3, unit=7)
    link.open()
    with pytest.raises(DeviceError, match=r"bytes that are no Modbus answer to the request"):
        link.read(0, 2)
    assert not link.is_open
    assert [r.message for r in caplog.records if "late answer" in r.message] == [
        f"a late answer from 127.0.0.1:{server.port} is dropped"
    ]


def test_the_first_unanswered_request_ends_the_connection() -> None:
    server = Answers(lambda _: b"")
    link = UnitConnection("127.0.0.1", server.port, 0.3, unit=7)
    link.open()
    with pytest.raises(DeviceLost, match=r"does not answer \(0.3 s\)"):
        link.read(0, 2)
    assert not link.is_open
    with pytest.raises(DeviceLost, match="is closed"):
        link.read(0, 2)
    server.join()


def test_an_answer_of_another_size_or_function_ends_the_connection() -> None:
    with pytest.raises(DeviceError, match=r"6 bytes to function 3, expected 4 to function 3"):
        fetched(lambda request: words(numbered(request), [5, 6, 7]))
    with pytest.raises(DeviceError, match=r"function 4, expected 4 to function 3"):
        fetched(lambda request: words(numbered(request), [5, 6], function=4))


def test_a_write_that_was_not_confirmed_as_asked_is_an_error() -> None:
    server = Answers(lambda request: request[:-1] + b"\x09")
    link = UnitConnection("127.0.0.1", server.port, 0.5, unit=7)
    link.open()
    with pytest.raises(DeviceError, match="another write than that of register 100"):
        link.write(100, [3])
    assert not link.is_open
    server.join()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("address: 18", "address: 19"), r"exception 2: register 19 \(oil_temperature\)"),
        (("watchdog_register: 200", "watchdog_register: 250"), r"register 250 \(zero_by.watchd"),
        (("1: {address: 100", "1: {address: 400"), r"register 400 \(output 1\)"),
        (
            ("watchdog_register: 200", "watchdog_register: 210"),
            r"register 210 .* holds 0 after 1500 was wr",
        ),
    ],
)
def test_a_wrong_address_names_the_channels_behind_it(
    port: int, change: tuple[str, str], said: str
) -> None:
    driver = in_fake_time(rig_of(port, change))
    with pytest.raises(DeviceError, match=said):
        driver.connect()
    driver.close()


# -- what is wrong in the rig file ----------------------------------------------------------

NO_WATCHDOG = ("zero_by: {watchdog_register: 200, milliseconds: 1500}", "zero_by: none")
PISTON_1 = "{function: 3, address: 0, type: int16, scale: 0.01 mm, offset: 0 mm}"


def test_a_module_without_a_watchdog_is_refused_unless_accepted(
    port: int, caplog: pytest.LogCaptureFixture
) -> None:
    rig = rig_of(port, NO_WATCHDOG)
    with pytest.raises(InputError, match=r"wire: zero_by: .*accept_no_watchdog: true"):
        ModbusMapDriver(rig.wire, rig)
    driver = in_fake_time(
        rig_of(port, (NO_WATCHDOG[0], NO_WATCHDOG[1] + "\n  accept_no_watchdog: true"))
    )
    with caplog.at_level(logging.WARNING):
        driver.connect()
    driver.close()
    assert "does not zero its outputs by itself" in caplog.text


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ((PISTON_1, "5"), r"wire: inputs.piston_1: expected keys and values, found 5"),
        (("piston_1: {function", "pistn_1: {function"), r"inputs.pistn_1: unknown; rig 'shin"),
        (("    spool_1:", "    drive_1:"), "inputs.drive_1: unknown"),
        (("scale: 0.01 mm", "scale: 0.01"), r"inputs.piston_1.scale: .*has no unit"),
        (("scale: 0.01 mm", "scale: 1 bar"), r"inputs.piston_1.scale: unit 'bar' is of another"),
        (("scale: 0.01 mm", "scale: 0 mm"), r"inputs.piston_1.scale: is zero"),
        (("scale: 0.01 mm", "scal: 0.01 mm"), r"inputs.piston_1.scal: unknown key; expected: "),
        (("offset: 0 mm", "offset: 3 s"), r"inputs.piston_1.offset: unit 's'"),
        (("0.1 delta_degC", "0.1 degC"), r"inputs.oil_temperature.scale: .* 'delta_degC'"),
        (("{function: 3, address: 0", "{function: 1, address: 0"), r"inputs.piston_1.function: "),
        (("{function: 3, address: 0", "{address: 0"), r"inputs.piston_1.function: is missing"),
        (("address: 0, type: int16", "address: 0, type: int8"), r"piston_1.type: .*found 'int8'"),
        (("word_order: little", "word_order: middle"), r"cap_pressure_1.word_order: "),
        (("address: 0, ", "address: 1, "), r"address: register 1 belongs to inputs.*_1 .* as well"),
        (("address: 4, ", "address: 3, "), r"inputs.rod_pressure_1.address: register 3 belongs to"),
        (("address: 4, ", "address: 65535, "), r"inputs.rod_pressure_1.address: .*past register"),
        (("address: 4, ", "address: 70000, "), r"inputs.rod_pressure_1.address: .*found 70000"),
        (("2: {address: 101", "3: {address: 101"), r"outputs.3: unknown; the joints are: 1 2"),
        (("address: 101", "address: 100"), r"outputs.2.address: register 100 belongs to"),
        (
            ("int16, scale: 0.01 mm", "int16, scale: 0.5 um"),
            r"inputs.piston_1: its numbers end at -0.016384 and 0.0163835 m, expected them to",
        ),
        (("uint16, scale: 1 kPa", "uint16, scale: 0.1 kPa"), r"inputs.rod_pressure_2: its numbers"),
        (
            ("scale: 0.005 V", "scale: 0.1 mV"),
            r"outputs.1.scale: .* hold -10 V of .* range of int16",
        ),
        (
            ("type: int16, scale: 5 mV", "type: uint16, scale: 5 mV"),
            r"outputs.2.scale: the register cannot hold -10 V",
        ),
        (("register: 200", "register: 101"), r"zero_by.watchdog_register: 101 is a register of o"),
        (("milliseconds: 1500", "milliseconds: 0"), r"zero_by.milliseconds: .*found 0"),
        (("milliseconds: 1500", "milliseconds: 2500"), r"zeroes its outputs after 2.5 s, wire.wat"),
        (("zero_by: {watchdog_register: 200, milliseconds: 1500}", "zero_by: maybe"), "zero_by"),
        (("  unit: 7", "  unit: 300"), r"wire: unit: .*found 300"),
        (("  unit: 7", "  slave: 7"), r"wire: slave: unknown key of wire modbus-map"),
        (("  host: 127.0.0.1\n", ""), r"wire: host: wire modbus-map needs it"),
    ],
)
def test_a_wrong_map_is_refused_by_the_name_of_its_key(change: tuple[str, str], said: str) -> None:
    rig = rig_of(change=change)
    with pytest.raises(InputError, match=said):
        ModbusMapDriver(rig.wire, rig)


def test_a_channel_without_a_register_is_named() -> None:
    line = next(line for line in WIRE.splitlines() if "supply_pressure" in line)
    rig = rig_of(change=(line.format() + "\n", ""))
    with pytest.raises(InputError, match=r"wire: inputs: no entry for: supply_pressure"):
        ModbusMapDriver(rig.wire, rig)


def test_a_key_that_stands_twice_is_refused_with_its_line() -> None:
    with pytest.raises(InputError, match=r"plain.yaml:\d+: key 'spool_1' occurs twice"):
        rig_of(change=("    piston_1:", "    spool_1:"))


def test_it_is_found_by_its_name_and_has_only_its_own_endpoint(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    entry = EntryPoint("modbus-map", "drivers.modbus_map:ModbusMapDriver", registry.GROUP)
    monkeypatch.setattr(registry, "_installed", lambda: EntryPoints([entry]))
    rig = rig_of()
    assert isinstance(make_driver(rig.wire, rig), ModbusMapDriver)
    with pytest.raises(InputError, match="expected the settings of modbus-map in the rig file"):
        wire_at("modbus-map://127.0.0.1:503", rig.wire)
    assert wire_at("modbus-map://127.0.0.1:502", rig.wire) == rig.wire
