"""Somebody wires, configures or addresses the bench wrongly: one line says what to change."""

from __future__ import annotations

import ctypes
import os
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from hil_sim.device.device import Device
from hil_sim.device.message_session import MessageSession
from hil_sim.device.server import CAN, RTU, SERIAL, TCP
from hil_sim.link.served import ServedDevice
from rig.model.wire import registers as reg
from rig.runs.rigs import load_rig
from tests.cli import strange_peers
from tests.cli.bench import bramah, bramah_here, words
from tests.drivers.plain_module import WIRE, module_process
from tests.drivers.test_modbus_map import rig_text
from tests.hil_sim.integrator import IntegratorPlant
from tests.variants import kept

RIG = "shinshu-2dof"
INPUT, LOST = 2, 4
PR_CAPBSET_DROP, CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH = 24, 1, 2  # prctl(2), capabilities(7)


def refused(done: subprocess.CompletedProcess[str], code: int, *says: str) -> str:
    """Check the exit code, that one line was said, and that it holds all of `says`."""
    lines = done.stderr.strip().splitlines()
    assert (done.returncode, len(lines)) == (code, 1), done.stderr
    assert "Traceback" not in done.stderr
    for part in says:
        assert part in lines[0], lines[0]
    return lines[0]


def probed(endpoint: str) -> subprocess.CompletedProcess[str]:
    return bramah_here("probe", "--rig", RIG, "--endpoint", endpoint)


@contextmanager
def rig_file(folder: Path, port: int, *changes: tuple[str, str]) -> Iterator[Path]:
    """The rig file of the plain I/O module with some texts changed."""
    wire = WIRE.format(port=port)
    for old, new in changes:
        assert old in wire
        wire = wire.replace(old, new)
    path = folder / "plain.yaml"
    path.write_text(rig_text(wire))
    yield path


def _obey_permissions() -> None:
    """Let even an administrator's command be refused a file that nobody may open."""
    if os.geteuid() == 0:
        for capability in (CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH):
            ctypes.CDLL(None).prctl(PR_CAPBSET_DROP, capability, 0, 0, 0)


# -- another program, or nobody -------------------------------------------------------------


@pytest.mark.parametrize(
    "endpoint", ["modbus-tcp://127.0.0.1:{}", "can://socketcand/127.0.0.1:{}/can0"]
)
def test_a_web_server_at_the_port_is_named_as_another_program(endpoint: str) -> None:
    with strange_peers.web_server() as port:
        line = refused(probed(endpoint.format(port)), LOST, f"127.0.0.1:{port}")
    assert "another program" in line
    assert "check" in line


def test_a_server_that_greets_is_named_as_no_socketcand() -> None:
    with strange_peers.talking_server(b"SSH-2.0-OpenSSH_9.6\r\n") as port:
        endpoint = f"can://socketcand/127.0.0.1:{port}/can0"
        refused(probed(endpoint), LOST, "is no socketcand", "SSH-2.0")


def test_a_register_map_at_a_web_server_is_named(tmp_path: Path) -> None:
    quick = ("timeout: 5 s", "timeout: 0.5 s")
    with strange_peers.web_server() as port, rig_file(tmp_path, port, quick) as path:
        refused(bramah_here("probe", "--rig", path), LOST, f"127.0.0.1:{port}", "another program")


@pytest.mark.parametrize(
    ("endpoint", "says"),
    [
        ("modbus-tcp://127.0.0.1:9", ("nothing answers at 127.0.0.1:9", "`bramah sim`")),
        ("can://socketcand/127.0.0.1:9/can0", ("nobody listens at 127.0.0.1:9", "socketcand")),
        ("serial:///dev/ttyNONE7", ("there is no port /dev/ttyNONE7", "plugged in")),
        ("modbus-rtu:///dev/ttyNONE7", ("there is no port /dev/ttyNONE7", "plugged in")),
        ("can://slcan/dev/ttyNONE7", ("there is no slcan/dev/ttyNONE7", "plugged in")),
    ],
)
def test_where_nothing_is_the_place_is_named(endpoint: str, says: tuple[str, ...]) -> None:
    refused(probed(endpoint), LOST, *says)


# -- the serial line ------------------------------------------------------------------------


@pytest.mark.parametrize("wire", ["serial", "modbus-rtu"])
def test_a_wrong_baud_rate_is_suspected_where_nothing_that_comes_is_a_frame(wire: str) -> None:
    with strange_peers.other_baud_rate() as name:
        line = refused(probed(f"{wire}://{name}"), LOST, name, "no valid frame in", "check `baud`")
    assert " 0 bytes" not in line


@pytest.mark.parametrize(
    "endpoint", kept(["serial://{}", "modbus-rtu://{}", "can://slcan{}"], (0,))
)
def test_a_port_that_this_user_may_not_open_says_which_group_to_join(endpoint: str) -> None:
    with strange_peers.other_baud_rate() as port:
        Path(port).chmod(0)
        at = endpoint.format(port)
        line = words("probe", "--rig", RIG, "--endpoint", at)
        done = subprocess.run(
            line, capture_output=True, text=True, check=False, preexec_fn=_obey_permissions
        )
    refused(done, LOST, "no permission to open", port, "dialout")


def test_a_file_that_is_no_port_is_refused(tmp_path: Path) -> None:
    port = tmp_path / "notes.txt"
    port.write_text("no port")
    for wire in ("serial", "modbus-rtu"):
        refused(probed(f"{wire}://{port}"), LOST, str(port), "no serial port")


# -- the register map -----------------------------------------------------------------------


def test_a_wrong_word_order_is_suspected_by_probe(tmp_path: Path) -> None:
    wrong = (
        "cap_pressure_1: {function: 3, address: 2, type: float32, word_order: little",
        "cap_pressure_1: {function: 3, address: 2, type: float32, word_order: big",
    )
    with module_process() as (_, port), rig_file(tmp_path, port, wrong) as path:
        shown = bramah_here("probe", "--rig", path)
    assert shown.returncode == 1, shown.stderr
    (row,) = (line for line in shown.stdout.splitlines() if line.startswith("cap_pressure_1"))
    assert "word order?" in row
    assert "word_order: little" in row
    others = [line for line in shown.stdout.splitlines() if "_pressure" in line and line != row]
    assert not any("word order" in line for line in others)
    assert "pressure not known: joint 1 cap (word order?" in shown.stdout
    assert "not plausible: cap_pressure_1" in shown.stderr


@pytest.mark.parametrize(
    ("change", "says"),
    [
        pytest.param(("unit: 7", "unit: 8"), ("unit 8", "check `unit`"), marks=pytest.mark.slow),
        (("address: 18", "address: 19"), ("register 19 (oil_temperature)", "manual")),
        (("function: 4, address: 18", "function: 3, address: 18"), ("oil_temperature",)),
    ],
)
def test_a_wrong_unit_or_register_is_named(
    tmp_path: Path, change: tuple[str, str], says: tuple[str, ...]
) -> None:
    quick = ("timeout: 5 s", "timeout: 0.5 s")
    with module_process() as (_, port), rig_file(tmp_path, port, change, quick) as path:
        refused(bramah_here("probe", "--rig", path), LOST, *says)


# -- before the night ------------------------------------------------------------------------

ON_MAP = [
    ("address: 0, type: int16, scale: 0.01 mm", "address: 0, type: int16, scale: 1 kN",
     "inputs.piston_1.scale"),
    ("{watchdog_register: 200, milliseconds: 1500}", "none", "zero_by"),
    ("spool_1: {function: 3, address: 1,", "spool_1: {function: 3, address: 2,",
     "inputs.cap_pressure_1.address"),
    ("    2: {address: 101, type: int16, scale: 5 mV}\n", "", "outputs"),
]  # fmt: skip
IN_PLACE = [
    ("{kind: can, bus: socketcan/can0, bitrate: 125000}", "bitrate"),
    ("{kind: can, bus: socketcan/can0, dbc: nosuch.dbc}", "dbc"),
    ("{kind: canopen-408, bus: socketcan/can0, nodes: [1, 1]}", "nodes"),
    ("{kind: canopen-408, bus: socketcan/can0, host: 1}", "nodes"),
    ("{kind: canopen-408, bus: socketcan/can0, eds: nosuch.eds}", "eds"),
    ("{kind: nidaqmx, inputs: {}, outputs: {}}", "inputs"),
    ("{kind: serial, device: /dev/ttyUSB0, baud: 9600}", "baud"),
    ("{kind: in-process, object: nosuch:thing}", "object"),
    ("{kind: replay, run: nofolder}", "run"),
]


def refused_alike(path: Path, key: str, queue: Path) -> None:
    """What a run would refuse at night is refused by every command, with file, line and key."""
    lines = path.read_text().splitlines()
    for line in (
        ("check", "lock-and-excite", "--rig", path),
        ("probe", "--rig", path),
        ("run", "lock-and-excite", "--rig", path, "--out", queue / "run"),
        ("queue", "add", "lock-and-excite", "--rig", path, "--queue", queue / "night.sqlite"),
    ):
        said = refused(bramah_here(*line), INPUT, f"{path}:", f"wire: {key}")
        at = int(said.partition(f"{path}:")[2].partition(":")[0])
        named = lines[at - 1]
        assert key.rpartition(".")[2] in named or named.startswith("wire:"), said
    assert not queue.exists()


@pytest.mark.parametrize(("old", "new", "key"), ON_MAP)
def test_a_register_map_is_refused_before_the_night(
    tmp_path: Path, old: str, new: str, key: str
) -> None:
    with rig_file(tmp_path, 9, (old, new)) as path:
        refused_alike(path, key, tmp_path / "queue")


@pytest.mark.parametrize(("wire", "key"), IN_PLACE)
def test_a_wire_without_what_it_names_is_refused_before_the_night(
    tmp_path: Path, wire: str, key: str
) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(rig_text(f"wire: {wire}").replace("sample_rate: 100 Hz", "sample_rate: 1 kHz"))
    refused_alike(path, key, tmp_path / "queue")


def test_an_endpoint_at_which_no_session_could_begin_is_not_queued(tmp_path: Path) -> None:
    night = tmp_path / "queue" / "night.sqlite"
    line = ("queue", "add", "lock-and-excite", "--rig", RIG, "--queue", night, "--endpoint")
    for endpoint, key in (
        ("replay:///nofolder", "run"),
        ("serial:///dev/ttyUSB0?baud=9600", "baud"),
    ):
        refused(bramah_here(*line, endpoint), INPUT, f"rig {RIG!r}: wire: {key}")
    assert not night.exists()


def test_a_condition_on_a_channel_that_the_bench_lacks_is_not_queued(tmp_path: Path) -> None:
    night = tmp_path / "queue" / "night.sqlite"
    line = ("queue", "add", "lock-and-excite", "--rig", "boom-1dof", "--queue", night)
    said = refused(
        bramah_here(*line, "--when", "cap_pressure_2 > 1 bar"), INPUT, "does not measure"
    )
    assert "expected one of: spool_1 piston_1 cap_pressure_1" in said
    assert not night.exists()


# -- the device's own protocol --------------------------------------------------------------


def _newer_identity(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(reg, "PROTOCOL_VERSION", 2)


def _newer_messages(patch: pytest.MonkeyPatch) -> None:
    answered = MessageSession.receive

    def newer(session: MessageSession, frame):
        answer = answered(session, frame)
        return None if answer is None else replace(answer, version=2)

    patch.setattr(MessageSession, "receive", newer)


@pytest.mark.parametrize(
    ("wire", "speak"),
    [
        (TCP, _newer_identity),
        pytest.param(RTU, _newer_identity, marks=pytest.mark.slow),
        (SERIAL, _newer_identity),
        (CAN, _newer_identity),
        pytest.param(SERIAL, _newer_messages, marks=pytest.mark.slow),
        (CAN, _newer_messages),
    ],
)
def test_a_device_of_another_protocol_version_is_refused_with_both_versions(
    wire: str, speak: Callable[[pytest.MonkeyPatch], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    speak(monkeypatch)
    rig = load_rig(RIG)
    device = Device(rig, IntegratorPlant(rig), realtime=False)
    with ServedDevice(device, wire) as served:
        # A process of its own: this one has the device's version, not the program's.
        done = bramah("probe", "--rig", RIG, "--endpoint", served.link.endpoint)
    line = refused(done, LOST, "version 2", "update the older")
    assert "this program version 1" in line


# -- the DBC file ---------------------------------------------------------------------------


def test_a_dbc_file_without_a_needed_signal_is_refused_by_the_signals_name(tmp_path: Path) -> None:
    made = bramah_here("dbc", "--rig", RIG)
    assert made.returncode == 0, made.stderr
    lines = made.stdout.splitlines(keepends=True)
    left = [line for line in lines if " cap_pressure_1 " not in line]
    assert len(left) < len(lines)
    dbc = tmp_path / "bench.dbc"
    dbc.write_text("".join(left))
    endpoint = f"can://socketcand/127.0.0.1:9/can0?dbc={dbc}"
    refused(probed(endpoint), INPUT, str(dbc), "cap_pressure_1", "bramah dbc")
