"""`bramah conformance` on a device in a process of its own."""

from __future__ import annotations

import json
from pathlib import Path

from tests.cli.bench import bramah_here
from tests.drivers.wires import device_process


def test_a_device_is_checked_and_nothing_put_out(tmp_path: Path) -> None:
    report = tmp_path / "report.json"
    with device_process("virtual") as (_, port):
        at = f"modbus-tcp://127.0.0.1:{port}"
        modbus = ("conformance", "modbus-tcp", "--endpoint", at)
        checked = bramah_here(*modbus, "--json", report)
        assert checked.returncode == 0
        other = bramah_here("conformance", "modbus-rtu", "--endpoint", at)
        assert other.returncode == 2
        unknown = bramah_here(*modbus, "--only", "levitation")
        assert unknown.returncode == 2
        driven = bramah_here(*modbus, "--outputs", "--only", "zero_within_one_block")
        assert driven.returncode == 0
        assert "the joints will move" in driven.stderr
    verdicts = {one["check"]: one["verdict"] for one in json.loads(report.read_text())["results"]}
    assert verdicts["identity"] == "passed"
    assert verdicts["waveform_is_played"] == "skipped"
    assert "samples_in_order" in checked.stdout
    assert "expected that driver, or --endpoint modbus-rtu://" in other.stderr
    assert "no check is called 'levitation'" in unknown.stderr


def test_nobody_there_is_a_lost_device() -> None:
    gone = bramah_here("conformance", "modbus-tcp", "--endpoint", "modbus-tcp://127.0.0.1:1")
    assert gone.returncode == 4
