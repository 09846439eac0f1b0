"""The measured positioning system: published values found again, unseen motion predicted.

The record is public (Janot, Gautier and Brunot, 2019) and not part of this repository.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from analysis.trace.engine import trace
from rig.runs.exchange.importer import import_records
from tests.studies.machines import emps as study

PLACE = Path(os.environ.get("BRAMAH_DATA", Path(__file__).parents[3] / "shared" / "data"))
FILE = PLACE / "emps" / "DATA_EMPS.mat"

if not FILE.exists():
    pytest.skip(f"no measured record at {FILE}", allow_module_level=True)


@pytest.fixture(scope="module")
def data() -> study.Emps:
    return study.load(FILE)


def test_the_documented_manifest_reads_it(tmp_path: Path) -> None:
    page = (Path(__file__).parents[2] / "docs" / "emps.md").read_text()
    manifest = page.split("```yaml\n", 1)[1].split("```", 1)[0]
    (tmp_path / "emps.yaml").write_text(manifest)
    (tmp_path / "DATA_EMPS.mat").symlink_to(FILE.resolve())
    report = import_records(tmp_path / "emps.yaml", tmp_path / "run")
    assert (report.samples, report.warnings) == (24841, ())


def test_all_four_parameters_are_the_published_ones(data: study.Emps) -> None:
    found = study.fit(data.whole)
    for name, value in study.PUBLISHED.items():
        assert found.estimates[name].value == pytest.approx(value, rel=0.01), name
    assert found.estimates["M1"].unit == "kg"


def test_two_lacking_effects_are_worse_when_only_one_is_added(data: study.Emps) -> None:
    errors = {
        name: 1e3 * study.open_loop(study.fit(data.whole, effects).model, data.whole)
        for name, effects in study.MODELS.items()
    }
    assert errors["M Fv (textbook)"] == pytest.approx(95.0, rel=0.05)
    assert errors["with Fc"] > 150.0
    assert errors["with Fc and offset"] < 5.5


def test_motion_that_the_fit_never_saw_is_predicted(data: study.Emps) -> None:
    both = study.MODELS["with Fc and offset"]
    on_second, on_first = study.unseen(data, both, "output-error")
    assert max(on_second, on_first) <= 6.4e-3
    # The machine's offset drifts: of the first half's rows alone 7.3 mm.
    on_second, on_first = study.unseen(data, both, "ls")
    assert on_first < 6.4e-3 < on_second < 7.5e-3
    assert study.open_loop(study.fit(data.second, ()).model, data.first) > 35e-3


def test_the_offset_drifts_from_cycle_to_cycle(data: study.Emps) -> None:
    offsets = [study.fit(run).estimates["offset1"].value for run in data.cycles]
    assert offsets == sorted(offsets, reverse=True)
    assert offsets[0] - offsets[-1] > 0.2


def test_the_machines_own_controller_gives_its_position_and_drive(data: study.Emps) -> None:
    values = {n: e.value for n, e in study.fit(data.whole).estimates.items()}
    q, v = study.closed_loop(values, 35.15065, data)
    channels = data.whole.records[0].channels
    assert np.sqrt(np.mean((q - channels["position_1"]) ** 2)) < 10e-6
    drive = channels["drive_1"]
    assert np.linalg.norm(v - drive) / np.linalg.norm(drive) < 0.06


@pytest.mark.slow
@pytest.mark.parametrize("period", [0, study.PERIOD])
def test_the_trace_names_the_same_two_causes_with_and_without_the_period(period: int) -> None:
    halves = study.load(FILE, period)
    found = trace([halves.first], [halves.second], look_ahead=False)
    assert found.verdict == "explained"
    assert {e.name for e in found.effects} == {"coulomb_friction", "asymmetric_viscous_friction"}
    assert found.after["torque_1"] < 0.043 * found.size["torque_1"]
    assert found.rmse_after["position_1"] < 8e-3
