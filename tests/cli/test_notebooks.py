"""The notebooks of the documentation run as they stand, in an empty folder."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from protocols.files.library import load, read_protocol
from rig import notebook
from rig.model.parse import InputError
from rig.model.records import Record, Run
from rig.runs.rigs import load_rig
from tests.cli.bench import ROOT
from tests.full_disk import largest_file

PAGES = ROOT / "docs" / "notebooks"


def executed(name: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Run the code of a notebook, cell by cell; returns what it has defined."""
    monkeypatch.chdir(folder)
    page = json.loads((PAGES / f"{name}.ipynb").read_text("utf-8"))
    assert page["nbformat"] == 4
    space: dict[str, Any] = {"__name__": "__main__"}
    for cell in page["cells"]:
        if cell["cell_type"] == "code":
            assert cell["outputs"] == []  # a notebook is kept without what it once said
            code = "".join(cell["source"])
            exec(compile(code, f"{name}, {cell['id']}", "exec"), space)
    return space


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_from_a_run_to_a_model_that_knows_the_worn_seal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    space = executed("from-run-to-model", tmp_path, monkeypatch)
    said = capsys.readouterr().out
    assert "step1_r1 3000 samples at 1000.0 Hz" in said
    monday = space["monday"]
    table = space["table"]
    assert list(table.columns) == list(monday.records[0].channels)
    assert table.attrs["units"]["cap_pressure_1"] == "Pa"
    assert table.index[0] == monday.records[0].start
    assert np.diff(table.index).max() == pytest.approx(1e-3)
    assert space["traced"].verdict == "explained"
    (effect,) = space["traced"].effects
    assert (effect.name, effect.where) == ("internal_leakage", "joint 2")
    before = space["judged"][0].fit["piston_2"]
    assert space["after"][0].fit["piston_2"] > max(before, 95.0)
    assert (tmp_path / "model.json").exists()


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_step_is_changed_and_its_records_taken_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    space = executed("change-a-step", tmp_path, monkeypatch)
    said = capsys.readouterr().out
    assert "times this amplitude would pass" in said
    assert space["errors"]["second"] < 0.5 * space["errors"]["first"]
    assert space["gains"]["large"].value == pytest.approx(6.28e-7, rel=0.01)
    assert [one.repeat for one in space["large"].records] == [1, 2, 3, 4]
    kept = load(tmp_path / "large.yaml")
    assert kept == space["second"]


def test_a_key_that_a_step_does_not_have_is_named() -> None:
    protocol = load("lock-and-excite")
    for changes, said in (
        ({"repeat": 2}, "repeat: no key 'repeat' here; expected one of:"),
        ({"excite.3.signal": {}}, "excite.3.signal: no key '3' here; expected one of: 0 to 0"),
        ({"excite.0.signal.amplitude": "1 kg"}, "unit 'kg' is of another dimension"),
        ({"repeats": 0}, "repeats: expected greater than or equal to 1, found 0"),
    ):
        with pytest.raises(InputError) as caught:
            notebook.changed(protocol, "step1", changes)
        assert "step 'step1'" in str(caught.value)
        assert said in str(caught.value)
    with pytest.raises(InputError, match="no step 'step9'; it has: step1 step2 step3"):
        notebook.changed(protocol, "step9", {})


def test_a_step_within_a_repetition_is_changed_too_and_nothing_else() -> None:
    text = """
name: nested
joints: 2
steps:
  - repeat_until: b.rsd < 1 %
    at_most: 2
    steps:
      - name: inner
        lock: [{joint: 1, at: closed}]
        excite: [{joint: 2, signal: {kind: sine, frequency: 1 Hz, amplitude: 0.4 V}}]
  - mark: end
"""
    protocol = read_protocol(text, "nested.yaml")
    made = notebook.changed(protocol, "inner", {"excite.0.signal.amplitude": "600 mV"})
    assert made.excitations[0].excite[0].signal.volts == pytest.approx(0.6)
    back = notebook.changed(made, "inner", {"excite.0.signal.amplitude": "0.4 V"})
    assert back.steps[1:] == protocol.steps[1:]
    assert back.excitations == protocol.excitations


def test_a_record_or_channel_that_is_not_there_is_named() -> None:
    one = Record("s_r1", "s", (1,), 1, 1000.0, {"piston_1": np.zeros(10)})
    run = Run(load_rig("shinshu-2dof"), (one,), "somewhere")
    with pytest.raises(InputError, match="somewhere: has no record 's_r2'; it has: s_r1"):
        notebook.record(run, "s_r2")
    with pytest.raises(InputError, match="no channel 'piston_9'; it has: piston_1"):
        notebook.plot(run, "s_r1", ["piston_9"])
    assert notebook.units(run) == {"piston_1": "m"}
    assert notebook.plot(run, "s_r1")._repr_svg_().lstrip().startswith("<?xml")


def test_a_plot_that_the_disk_does_not_take_leaves_the_one_before(tmp_path: Path) -> None:
    one = Record("s_r1", "s", (1,), 1, 1000.0, {"piston_1": np.zeros(10)})
    drawn = notebook.plot(Run(load_rig("shinshu-2dof"), (one,), "somewhere"), "s_r1")
    saved = drawn.save(tmp_path / "stroke.svg")
    before = saved.read_bytes()
    assert before.rstrip().endswith(b"</svg>")
    with largest_file(len(before) // 2), pytest.raises(OSError, match="too large"):
        drawn.save(saved)
    assert saved.read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["stroke.svg"]


def test_the_page_names_every_function() -> None:
    page = (ROOT / "docs" / "api.md").read_text("utf-8")
    missing = [
        name for name in notebook.__all__ if f"`{name}" not in page and f".{name}" not in page
    ]
    assert missing == []
