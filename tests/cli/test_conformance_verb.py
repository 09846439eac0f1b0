"""`bramah conformance` on a device in a process of its own."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from rig.cli.main import run
from tests.drivers.wires import device_process


def exit_code(*words: str) -> int:
    with pytest.raises(SystemExit) as ended:
        run(["conformance", *words])
    return int(ended.value.code or 0)


def test_a_device_is_checked_and_nothing_put_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report = tmp_path / "report.json"
    with device_process("virtual") as (_, port):
        at = f"modbus-tcp://127.0.0.1:{port}"
        assert exit_code("modbus-tcp", "--endpoint", at, "--json", str(report)) == 0
        assert exit_code("modbus-rtu", "--endpoint", at) == 2
        assert exit_code("modbus-tcp", "--endpoint", at, "--only", "levitation") == 2
        out = capsys.readouterr()
        driving = ("--outputs", "--only", "zero_within_one_block")
        assert exit_code("modbus-tcp", "--endpoint", at, *driving) == 0
        assert "what they drive will move" in capsys.readouterr().err
    verdicts = {one["check"]: one["verdict"] for one in json.loads(report.read_text())["results"]}
    assert verdicts["identity"] == "passed"
    assert verdicts["waveform_is_played"] == "skipped"
    assert "samples_in_order" in out.out
    assert "name that, or give --endpoint modbus-rtu://" in out.err
    assert "no check is called 'levitation'" in out.err


def test_nobody_there_is_a_lost_device() -> None:
    assert exit_code("modbus-tcp", "--endpoint", "modbus-tcp://127.0.0.1:1") == 4
