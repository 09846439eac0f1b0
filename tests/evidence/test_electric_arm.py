"""Somebody with an electric arm on a slope: record, import, identify with friction, validate."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.cli.bench import bramah, study


@pytest.mark.slow
def test_an_arm_on_a_slope_from_its_files_to_its_parameters(tmp_path: Path) -> None:
    made = study("electric", "--slope", "12", "--seed", "101", "--out", tmp_path / "arm")
    assert made.returncode == 0, made.stderr
    assert "base_inclination" in made.stdout
    truth = json.loads((tmp_path / "arm" / "truth.json").read_text())
    assert truth["base_inclination"] == pytest.approx(0.2094395)

    run, model = tmp_path / "arm" / "run", tmp_path / "model.json"
    found = bramah(
        "identify", run, "--with", "coulomb_friction", "--json", "-", "--model", model
    )  # fmt: skip
    assert found.returncode == 0, found.stderr
    parameters = json.loads(found.stdout)["parameters"]
    assert parameters["base_inclination"]["value"] == pytest.approx(0.2094395, rel=0.01)
    assert parameters["Fc1"]["unit"] == "N*m"
    judged = bramah("validate", model, run, "--json", "-")
    assert judged.returncode == 0, judged.stderr
    records = json.loads(judged.stdout)["records"]
    assert min(f for r in records for f in r["fit"].values()) > 97.0

    unknown = bramah("identify", run, "--with", "magic")
    assert unknown.returncode == 2
    assert "unknown term 'magic'" in unknown.stderr
    driven = bramah("check", "lock-and-excite", "--rig", "electric-2dof")
    assert driven.returncode == 2
    assert "only hydraulic benches are driven" in driven.stderr
