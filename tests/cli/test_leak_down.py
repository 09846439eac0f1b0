"""A hold with every valve closed: it shows what leaks, and identifies nothing by mistake."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from analysis.identify.identify import identify
from analysis.identify.result import to_json
from rig.model.parse import InputError
from rig.runs.store import load_run
from tests.cli.bench import SHORT, bramah, simulated

RIG = "shinshu-2dof"
LEAK = "effects: [{name: internal_leakage, where: joint 2, conductance: 2e-12 m^3/(s*Pa)}]\n"


def identified(*runs: Path) -> dict[str, Any]:
    told = to_json(identify([load_run(run) for run in runs]))
    return dict(json.loads(json.dumps(told)))


def statement(told: dict[str, Any], name: str) -> tuple[bool, str]:
    (found,) = [check for check in told["checks"] if check["name"] == name]
    return found["ok"], found["detail"]


@pytest.mark.parametrize("leaks", [pytest.param(False, marks=pytest.mark.slow), True])
def test_a_hold_shows_the_leak_and_leaves_the_parameters_alone(leaks: bool, tmp_path: Path) -> None:
    (tmp_path / "short.yaml").write_text(SHORT)
    (tmp_path / "leak.yaml").write_text(LEAK if leaks else "effects: []\n")
    runs = {"short": (), "leak-down": ("--set", "time=2 s", "--set", "away=10 mm")}
    with simulated("--seed", 5, "--scenario", tmp_path / "leak.yaml") as (endpoint, _):
        for name, more in runs.items():
            protocol = tmp_path / "short.yaml" if name == "short" else name
            line = ("run", protocol, "--rig", RIG, "--endpoint", endpoint, *more)
            done = bramah(*line, "--out", tmp_path / name)
            assert done.returncode == 0, done.stderr
    middle, extended = load_run(tmp_path / "leak-down").records
    assert (middle.name, extended.name) == ("middle_r1", "extended_r1")
    assert middle.locked == extended.locked == (1, 2)
    piston = middle.channels["piston_2"]
    crept = float(piston[-100:].mean() - piston[:100].mean())
    assert middle.attributes["creep_m_2"] == pytest.approx(crept, abs=1e-6)
    assert (abs(crept) > 1e-3) is leaks
    assert abs(float(middle.attributes["creep_m_1"])) < 1e-4

    alone = identified(tmp_path / "short")
    both = identified(tmp_path / "short", tmp_path / "leak-down")
    assert both["parameters"] == alone["parameters"]
    assert both["rows"] == alone["rows"]
    assert statement(both, "repeats") == statement(alone, "repeats")
    ok, said = statement(both, "leak-down")
    assert ok is not leaks
    assert "with every valve closed joint" in said
    if leaks:
        assert "joint 2 crept" in said
        assert said.endswith("oil passes the piston, leaves the joint, or passes a valve at rest")
    assert not [check for check in alone["checks"] if check["name"] == "leak-down"]

    with pytest.raises(InputError, match="every record has every joint locked"):
        identify([load_run(tmp_path / "leak-down")])
