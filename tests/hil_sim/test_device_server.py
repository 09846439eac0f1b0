"""The device's process as other programs meet it: its port, its end, and the end of its host."""

from __future__ import annotations

import os
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Iterator

import pytest
from pymodbus.client import ModbusTcpClient

from hil_sim.device.lifetime import EndpointError
from hil_sim.device.server import serve, warm_up
from rig.model.wire import registers as reg
from rig.model.wire.registers import TripCause
from tests.drivers.wires import ROOT, device_process
from tests.hil_sim.integrator import IntegratorPlant, seed_rig

PATIENCE = 30.0  # a loaded machine may take long; the assertions do not depend on it

DEVICE = "from tests.hil_sim.integrator import main; main()"

# Its parent ends between the endpoint's line and the first request served.
ANNOUNCING = """
import os, sys, time
from hil_sim.device.lifetime import ParentProcess
from hil_sim.device.server import serve
from tests.hil_sim.integrator import IntegratorPlant, seed_rig

def announce(endpoint):
    print(endpoint, flush=True)
    while os.getppid() == int(sys.argv[2]):
        time.sleep(0.01)

rig = seed_rig()
serve(rig, IntegratorPlant(rig), on_ready=announce, parent=ParentProcess(int(sys.argv[2])))
"""

HOST = """
import sys
from drivers import make_driver
from drivers.base import OutputLaw
from tests.hil_sim.integrator import seed_rig

rig = seed_rig(port=int(sys.argv[1]), timeout=20.0, watchdog=10.0)
driver = make_driver(rig.wire, rig)
driver.connect()
driver.start()
driver.apply([OutputLaw(bias=1.0, limit=2.0), OutputLaw(bias=-1.0, limit=2.0)])
while True:
    block = driver.read_block()
    if block.data[-1, 10] > 0.9:
        print("driving", flush=True)
"""


def registers(client: ModbusTcpClient, register: reg.Register) -> list[int]:
    return list(client.read_input_registers(register.address, count=register.words).registers)


@pytest.mark.parametrize("mode", ["virtual", "realtime"])
def test_a_killed_host_leaves_outputs_at_zero(mode: str) -> None:
    with (
        device_process(mode) as (_, port),
        ModbusTcpClient("127.0.0.1", port=port, timeout=PATIENCE) as watcher,
        subprocess.Popen(
            [sys.executable, "-c", HOST, str(port)], stdout=subprocess.PIPE, text=True, cwd=ROOT
        ) as host,
    ):
        assert host.stdout is not None
        assert host.stdout.readline() == "driving\n"
        if mode == "realtime":
            assert registers(watcher, reg.STATUS_OUTPUTS)[:2] == [205, 0x10000 - 205]
        assert watcher.write_register(reg.CONTROL_STREAM.address, 0).exception_code == 6
        host.kill()
        host.wait(PATIENCE)
        deadline = time.monotonic() + PATIENCE
        while registers(watcher, reg.STATUS_CAUSE) == [0] and time.monotonic() < deadline:
            time.sleep(0.01)
        # Its watchdog would have waited ten seconds: the end of the connection was enough.
        assert registers(watcher, reg.STATUS_CAUSE) == [TripCause.HOST_LOST]
        assert registers(watcher, reg.STATUS_OUTPUTS) == [0] * 9
        tick = registers(watcher, reg.STATUS_TICK)
        tripped = registers(watcher, reg.STATUS_TRIP_TICK)
        assert tick[0] << 16 | tick[1] > tripped[0] << 16 | tripped[1]


def test_a_port_in_use_is_named() -> None:
    rig = seed_rig()
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(EndpointError, match=rf"127\.0\.0\.1:{port}: Address already in use"):
            serve(rig, IntegratorPlant(rig), port=port, on_ready=pytest.fail)


def test_warming_up_runs_exactly_one_block_of_zero_outputs() -> None:
    rig = seed_rig()
    spare = IntegratorPlant(rig)
    warm_up(rig, spare)
    assert (spare.tick, spare.piston) == (10, [0.0, 0.0])


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_it_ends_cleanly_when_asked(number: signal.Signals) -> None:
    with (
        device_process("realtime") as (process, port),
        socket.create_connection(("127.0.0.1", port), timeout=PATIENCE) as client,
    ):
        process.send_signal(number)
        assert process.wait(PATIENCE) == 0
        assert client.recv(1) == b""


@pytest.mark.parametrize("script", [DEVICE, ANNOUNCING], ids=["serving", "announcing"])
def test_it_ends_with_the_process_it_belongs_to(script: str) -> None:
    # A parent that starts the device and is killed: nobody is left to end it but itself.
    parent_script = (
        "import os, subprocess, sys;"
        "p = subprocess.Popen([sys.executable, '-c', sys.argv[1], 'virtual', str(os.getpid())],"
        " stdout=subprocess.PIPE, text=True);"
        "print(p.pid, p.stdout.readline(), flush=True);"
        "p.wait()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", parent_script, script], stdout=subprocess.PIPE, text=True, cwd=ROOT
    ) as parent:
        assert parent.stdout is not None
        pid, endpoint = parent.stdout.readline().split()
        port = int(endpoint.rsplit(":", 1)[1])
        try:
            with socket.create_connection(("127.0.0.1", port), timeout=PATIENCE) as client:
                parent.kill()
                assert client.recv(1) == b""
        except TimeoutError:
            os.kill(int(pid), signal.SIGKILL)
            raise


@pytest.mark.parametrize(
    ("pdu", "exception"),
    [
        ("01 0000 0001", 1),  # coils: not a function of this device
        ("03 0400 0001", 2),  # no such register
        ("03 000F 0002", 0),  # the last reserved word and the first of the name
        ("03 001F 0002", 2),  # across the end of a group
        ("03 0000 0000", 3),  # nothing
        ("03 0000 007E", 3),  # more than an answer holds
        ("03 0100 007D", 6),  # the block, without control
        ("06 0082 0002", 3),  # zero_outputs takes 1
        ("10 0200 0002 05 0000 0000", 3),  # a byte count that does not fit
        ("10 0200 0002 04 7FC0 0000", 3),  # a gain that is no number
        ("10 0200 0002 04 3F80", 3),  # cut short
        ("17 0100 007D 0080 0001 02 0000", 2),  # acknowledge without heartbeat
        ("17 0100 007C 0080 0002 04 FFFF 0001", 2),  # a part of a block
    ],
)
def test_bad_requests_get_the_exception_the_page_names(
    server: socket.socket, pdu: str, exception: int
) -> None:
    body = b"\x01" + bytes.fromhex(pdu)
    server.sendall(struct.pack(">HHH", 1, 0, len(body)) + body)
    answer = server.recv(300)
    if exception:
        assert answer[7:] == bytes([body[1] | 0x80, exception])
    else:
        assert answer[7] == body[1]


@pytest.fixture(scope="module")
def port() -> Iterator[int]:
    with device_process("virtual") as (_, port):
        yield port


@pytest.fixture
def server(port: int) -> Iterator[socket.socket]:
    with socket.create_connection(("127.0.0.1", port), timeout=PATIENCE) as wire:
        yield wire


def test_noise_on_one_connection_does_not_disturb_another(port: int, server: socket.socket) -> None:
    for noise in (b"GET / HTTP/1.1\r\n\r\n", bytes(1000), b"\xff" * 300, b"\0\1\0\0\0\2\1\x99"):
        server.sendall(noise)
    with ModbusTcpClient("127.0.0.1", port=port, timeout=PATIENCE) as client:
        answer = client.read_holding_registers(reg.IDENTITY_MAGIC.address, count=2)
        assert answer.registers == [0x4252, 0x414D]


def test_requests_that_arrive_together_or_in_pieces_are_answered_in_order(
    server: socket.socket,
) -> None:
    body = b"\x01" + bytes.fromhex("03 0000 0002")
    frames = [struct.pack(">HHH", number, 0, len(body)) + body for number in range(1, 6)]
    stream = b"".join(frames)
    for piece in (stream[:5], stream[5:30], stream[30:]):
        server.sendall(piece)
        time.sleep(0.02)
    answers = b""
    while len(answers) < 5 * 13:
        answers += server.recv(300)
    found = [answers[at : at + 13] for at in range(0, len(answers), 13)]
    assert [struct.unpack_from(">H", answer)[0] for answer in found] == [1, 2, 3, 4, 5]
    assert {answer[9:] for answer in found} == {bytes.fromhex("42524 14D".replace(" ", ""))}
