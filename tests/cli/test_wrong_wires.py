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
    others = [line for line in shown.stdout.splitlines() if "pressure" in line and line != row]
    assert not any("word order" in line for line in others)
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
