"""What `check`, `design` and `identify --physical` tell a person."""

from __future__ import annotations

import json
from pathlib import Path

from analysis.simulation.model import save_model
from protocols.files import library
from protocols.files.plan import resolve
from rig.runs.rigs import load_rig
from tests.cli.bench import SHORT, bramah_here
from tests.cli.test_twin_model import identified

RIG = "shinshu-2dof"
QUICK = """
name: quick
joints: 2
steps:
  - name: step1
    lock: [{joint: 1, at: closed, tolerance: 5 mm}]
    excite:
      - joint: 2
        signal: &wave {kind: multisine, base_frequency: 0.5 Hz, f_min: 0.5 Hz, f_max: 8.5 Hz,
                       amplitude: 0.3 V, detection_fraction: 0.25, tilt: 0.3, seed: 1}
        centring: &centring {drift: 4 mm, offset: 4 mm}
    repeats: 2
    duration: 4 s
  - name: step2
    lock: [{joint: 2, at: end_min}]
    excite: [{joint: 1, signal: {<<: *wave, amplitude: 0.2 V, seed: 2}, centring: *centring}]
    repeats: 2
    duration: 4 s
  - name: step3
    lock: [{joint: 2, at: end_max}]
    excite: [{joint: 1, signal: {<<: *wave, amplitude: 0.15 V, seed: 3}, centring: *centring}]
    repeats: 2
    duration: 4 s
"""


def test_check_predicts_the_errors_and_names_what_a_protocol_leaves_open(tmp_path: Path) -> None:
    file = tmp_path / "short.yaml"
    file.write_text(SHORT)
    done = bramah_here("check", file, "--rig", RIG, "--json", tmp_path / "check.json")
    assert done.returncode == 0
    assert "std. error %" in done.stdout
    assert "NOT determined W1" in done.stdout
    told = json.loads((tmp_path / "check.json").read_text())
    assert told["ok"]
    found = told["identification"]
    assert found["parameters"]["W1"]["relative_std"] is None
    assert 0 < found["parameters"]["b"]["relative_std"] < 0.1
    assert found["rank"]["fluid"] == [5, 9]


def test_a_designed_protocol_is_a_file_like_any_other(tmp_path: Path) -> None:
    source, out = tmp_path / "quick.yaml", tmp_path / "made" / "b.yaml"
    source.write_text(QUICK)
    told = tmp_path / "design.json"
    line = ["design", source, "--rig", RIG, "--criterion", "b", "--budget", 8, "--out", out]
    done = bramah_here(*line, "--json", told)
    assert done.returncode == 0
    assert f"written to {out}" in done.stdout
    assert done.stderr.startswith("the twin uses the nominal values of the rig file\n")
    text = out.read_text()
    assert text.startswith("# Made by: bramah design ")
    before, after = json.loads(told.read_text())["parameters"]["b"].values()
    assert after < before
    made = library.load(out)
    plan = resolve(made, load_rig(RIG))
    first = resolve(library.load(source), load_rig(RIG))
    for ours, theirs in zip(plan.steps, first.steps, strict=True):
        assert (ours.period, ours.record, ours.repeats) == (
            theirs.period, theirs.record, theirs.repeats,
        )  # fmt: skip
        empty = theirs.excite[0].wave.detection_lines
        assert empty == ours.excite[0].wave.detection_lines
        assert not set(empty) & set(ours.lines)
    assert bramah_here("check", out, "--rig", RIG).returncode == 0


def test_a_design_keeps_the_limits_of_the_machine_that_was_identified(tmp_path: Path) -> None:
    source, out, fast = tmp_path / "quick.yaml", tmp_path / "b.yaml", tmp_path / "fast.json"
    source.write_text(QUICK)
    save_model(identified(load_rig(RIG), 1.3), fast)
    line = ["design", source, "--rig", RIG, "--criterion", "b", "--budget", 4, "--out", out]
    shown = bramah_here(*line[:-2], "--model", fast)
    assert shown.returncode == 0, shown.stderr
    assert "--out FILE writes it" in shown.stdout
    done = bramah_here(*line, "--model", fast)
    assert done.returncode == 0
    assert done.stdout == shown.stdout.replace("--out FILE writes it", f"written to {out}")
    assert f"predicted on: model {fast}" in done.stdout
    assert bramah_here("check", out, "--rig", RIG, "--model", fast).returncode == 0


def test_a_criterion_that_does_not_exist_is_refused(tmp_path: Path) -> None:
    out = tmp_path / "no.yaml"
    line = ["design", "lock-and-excite-multisine", "--rig", RIG, "--criterion", "c", "--out", out]
    done = bramah_here(*line)
    assert done.returncode == 2
    assert "expected D, E or a parameter" in done.stderr
    assert not out.exists()
