"""A night shift over a bad cable: the run is whole where it can be, and ends by name where not."""

from __future__ import annotations

from pathlib import Path

import pytest

from rig.runs.store import load_run
from tests.cli.bench import SHORT, bramah, bramah_here, simulated

RIG = "shinshu-2dof"


@pytest.fixture
def short(tmp_path: Path) -> Path:
    path = tmp_path / "short.yaml"
    path.write_text(SHORT)
    return path


def test_a_serial_line_that_loses_frames_costs_no_sample(short: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    with simulated("--wire", "serial", "--wire-faults", "frame_lost", "--seed", 4) as (at, _):
        assert at.startswith("serial:///")
        done = bramah("run", short, "--rig", RIG, "--out", run, "--endpoint", at)
    assert done.returncode == 0, done.stderr
    records = load_run(run).records
    assert [record.attributes["lost_samples"] for record in records] == [0, 0]


def test_a_cable_pulled_out_in_a_run_ends_it_by_name_and_keeps_what_came(
    short: Path, tmp_path: Path
) -> None:
    faults = tmp_path / "cable.yaml"
    faults.write_text("faults: [{name: link_closed, at: 3 s}]")
    run = tmp_path / "run"
    with simulated("--wire-faults", faults, "--seed", 4) as (at, _):
        done = bramah("run", short, "--rig", RIG, "--out", run, "--endpoint", at)
    assert done.returncode == 4
    assert "closed the connection" in done.stderr
    assert "Traceback" not in done.stderr
    assert (run / "records.h5").exists()
    assert (run / "state").read_text().strip() == "aborted"


@pytest.mark.parametrize(
    ("option", "unknown", "known"),
    [("--wire-faults", "frame_gone", "frame_lost"), ("--scenario", "worn-seals", "worn-seal")],
)
def test_a_name_nobody_knows_is_refused_before_anything_is_served(
    option: str, unknown: str, known: str
) -> None:
    done = bramah_here("sim", "--rig", RIG, "--port", 0, option, unknown)
    assert done.returncode == 2
    assert f"{option} {unknown}: expected a file, or one of: " in done.stderr
    assert known in done.stderr.replace(unknown, "").split()
