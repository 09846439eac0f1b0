"""A loop ended from outside leaves the bench safe, the records kept, and the reason told."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import pytest

from rig.runs.store import load_run
from tests.cli.bench import ENDLESS, LONG, outputs_are_zero, simulated, started, wait_for

RIG = "shinshu-2dof"


@pytest.fixture
def line(tmp_path: Path) -> tuple[object, ...]:
    protocol = tmp_path / "endless.yaml"
    protocol.write_text(ENDLESS)
    return (
        "loop", "--rig", RIG, "--out", tmp_path / "night", "--protocol", protocol, "--unattended",
    )  # fmt: skip


def told(out: Path) -> str:
    """Return why the loop says it stopped; it had no round to tell of."""
    story = json.loads((out / "loop.json").read_text())
    assert story["rounds"] == []
    return str(story["stopped"])


def test_ctrl_c_twice_closes_the_valves_and_ends_with_130(
    line: tuple[object, ...], tmp_path: Path
) -> None:
    with simulated() as (endpoint, _):
        with started(*line, "--endpoint", endpoint) as process:
            wait_for("record 3 of", process)
            process.send_signal(signal.SIGINT)
            process.send_signal(signal.SIGINT)
            _, errors = process.communicate(timeout=LONG)
            assert process.returncode == 130, errors
            assert "Traceback" not in errors
        assert outputs_are_zero(endpoint)
    assert told(tmp_path / "night")
    assert (tmp_path / "night" / "run-1" / "state").read_text().strip() == "aborted"
    assert len(load_run(tmp_path / "night" / "run-1").records) >= 2


def test_a_bench_that_dies_ends_the_loop_with_4_and_the_records_stay(
    line: tuple[object, ...], tmp_path: Path
) -> None:
    with (
        simulated() as (endpoint, bench),
        started(*line, "--endpoint", endpoint) as process,
    ):
        wait_for("record 3 of", process)
        os.kill(bench.pid, signal.SIGKILL)
        _, errors = process.communicate(timeout=LONG)
        assert process.returncode == 4, errors
        assert "Traceback" not in errors
    assert told(tmp_path / "night")
    assert len(load_run(tmp_path / "night" / "run-1").records) >= 2
