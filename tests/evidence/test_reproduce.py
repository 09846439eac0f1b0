"""The paper's sections as a page: every table there, figures that open, JSON that is JSON."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from analysis.report.paper import TABLE_III, TABLE_IV
from rig.cli.simulated.simulated_bench import simulated_bench
from rig.cli.text.output import write_json
from rig.model.records import Run
from rig.model.rig import Rig
from rig.runs.exchange.importer import import_records
from tests.analysis import small_bench as bench
from tests.analysis.small_bench import TRUTH
from tests.cli.bench import bramah_here
from tests.studies.pages import Section, Table, markdown, text, write_page
from tests.studies.reproduction.bench import Reproduction, Runs, Scale, analyse
from tests.studies.reproduction.story import TITLE, as_dict, command, page

TINY = Scale(repeats=2, payload_repeats=2, evaluations=40)
LOADED = {"M1": 3.25, "M2": 1.625, "R12": 1.625, "W1": 3.25, "W2": 3.25}
BOTH = bench.Step("both_1hz", (), (0.0, 0.0))


def sines(names: dict[str, bench.Step], hertz: float) -> dict[str, dict[int, bench.Excitation]]:
    """A sine for every joint that a step does not lock, gentle enough for the stroke."""
    amplitude = 0.05 if hertz == 1.0 else 0.08
    return {
        name: {
            i - 1: bench.Excitation.sine(amplitude, hertz) for i in (1, 2) if i not in step.locked
        }
        for name, step in names.items()
    }


def taken(
    rig: Rig,
    names: dict[str, bench.Step],
    *,
    repeats: int,
    seed: int,
    truth: dict[str, float] = TRUTH,
) -> Run:
    """Records of the small bench under the names that the protocols give."""
    records = []
    for hertz in (1.0, 3.0):
        chosen = {
            n: replace(s, name=n) for n, s in names.items() if n.endswith("3hz") == (hertz > 1)
        }
        if chosen:
            run = bench.experiment(
                rig, sines(chosen, hertz), repeats=repeats, seed=seed, seconds=5.0,
                steps=tuple(chosen.values()), truth=truth,
            )  # fmt: skip
            records += run.records
    return Run(rig, tuple(records), source="small bench")


@pytest.fixture(scope="module")
def steps() -> Run:
    return taken(bench.shinshu(), {step.name: step for step in bench.STEPS}, repeats=2, seed=1)


@pytest.fixture(scope="module")
def both() -> Run:
    return taken(bench.shinshu(), {"both_1hz": BOTH}, repeats=2, seed=3)


@pytest.fixture(scope="module")
def done(steps: Run, both: Run) -> Reproduction:
    """The whole analysis on another program's bench, two repeats, searches of forty candidates."""
    rig = bench.shinshu()
    three = {step.name: step for step in bench.STEPS}
    judged = {cell.step: three.get(cell.step.split("_")[0], BOTH) for cell in TABLE_IV}
    loaded = {**TRUTH, **{name: TRUTH[name] + more for name, more in LOADED.items()}}
    runs = Runs(
        steps,
        taken(rig, judged, repeats=1, seed=2),
        both,
        taken(rig, three, repeats=2, seed=4, truth=loaded),
        TRUTH,
    )
    return analyse(runs, seed=7, scale=TINY, say=lambda _: None)


def numbers(table: Table, row: str) -> list[str]:
    return list(next(cells for cells in table.rows if cells[0] == row))


def tables(sections: list[Section]) -> dict[str, Table]:
    return {p.caption: p for s in sections for p in s.parts if isinstance(p, Table)}


@pytest.mark.slow
def test_the_page_sets_every_number_beside_the_papers(done: Reproduction) -> None:
    found = tables(page(done, "python -m tests.studies reproduce"))
    third = found["Table III, 2 experiments"]
    assert [row[0] for row in third.rows] == list(TABLE_III)
    b = numbers(third, "b")
    assert b[2:6] == ["225", "233", "238", "2.15"]
    assert float(b[7]) == pytest.approx(233, abs=2)
    fourth = found["Table IV, FIT %"]
    assert [row[0] for row in fourth.rows] == [cell.step for cell in TABLE_IV]
    assert numbers(fourth, "step1_3hz")[2:5] == ["45.8", "45.5", "2.8"]
    assert all(float(row[5]) > 60 for row in fourth.rows)
    changed = found["Parameters without and with the payload"]
    assert {row[0] for row in changed.rows if row[7] == "responds"} == set(LOADED)
    assert all(row[8] == "yes" for row in changed.rows)
    methods = found["All methods on one bench"]
    assert [row[0] for row in methods.rows] == [
        "coupled", "sequential E1", "simultaneous", "simultaneous, paper's filter", "PSO", "GA",
    ]  # fmt: skip
    assert numbers(methods, "PSO")[1:3] == ["8 of 16", "0"]
    lost = found["Candidates without a valid state"]
    counts = [int(row[1]) for row in lost.rows if row[0].startswith("lost: ")]
    search = done.searches["pso"].found.extra["search"]
    assert sum(counts) == sum(search["lost"].values()) > 0


@pytest.mark.slow
def test_page_figures_and_json_can_be_read_by_other_programs(
    done: Reproduction, tmp_path: Path
) -> None:
    sections = page(done, command(7, True, tmp_path / "page.md"))
    write_page(tmp_path / "page.md", TITLE, sections)
    written = (tmp_path / "page.md").read_text()
    assert "python -m tests.studies reproduce --seed 7 --quick --docs" in written
    pictures = re.findall(r"\]\((page/[^)]+\.svg)\)", written)
    assert {Path(p).name for p in pictures} == {
        *(f"fig{k}.svg" for k in range(6, 11)), "search.svg",
    }  # fmt: skip
    for picture in pictures:
        root = ElementTree.parse(tmp_path / picture).getroot()
        assert root.tag == "{http://www.w3.org/2000/svg}svg"
    assert not re.search(r"\b(nan|inf|None)\b", written)
    write_json(tmp_path / "all.json", as_dict(done))
    data = json.loads((tmp_path / "all.json").read_text())
    assert data["payload"]["M2"]["responds"] is True
    assert data["experiments"]["count"] == 2
    assert data["searches"]["ga"]["identification"]["method"] == "ga"


def test_a_page_is_the_same_as_text_and_as_markdown() -> None:
    sections = [Section("Title", ("**Bold** words", Table("A table", ["a|b", "c"], [["1", "2"]])))]
    shown = text(sections)
    assert "Bold words" in shown
    assert "a|b  c" in shown
    marked = markdown("Page", sections, "page")
    assert marked.startswith("# Page\n\n## Title\n\n**Bold** words\n")
    assert "| a\\|b | c |\n|:--|--:|\n| 1 | 2 |\n" in marked


def test_a_simulated_bench_takes_a_scenario_file(tmp_path: Path) -> None:
    """The payload comes from a file; one that cannot be read ends the bench with its reason."""
    truth, scenario = tmp_path / "truth.json", tmp_path / "payload.yaml"
    scenario.write_text("effects:\n  - {name: payload, mass: 6.5 kg}\nparameters: {b: 210 MPa}\n")
    with simulated_bench("shinshu-2dof", seed=1, truth=truth, scenario=scenario) as endpoint:
        assert endpoint.startswith("modbus-tcp://")
        assert json.loads(truth.read_text())["b"] == pytest.approx(210e6)


@pytest.fixture(scope="module")
def run_folder(steps: Run, both: Run, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same records as a run folder, by way of CSV files and a manifest."""
    folder = tmp_path_factory.mktemp("imported")
    lines = ["rig: shinshu-2dof", "sample_rate: 1 kHz", "records:"]
    for record in (*steps.records, *both.records):
        names = list(record.channels)
        data = np.column_stack([record.channels[name] for name in names])
        file = folder / f"{record.name}.csv"
        np.savetxt(file, data, delimiter=",", header=",".join(names), comments="")
        lines.append(
            f"  - {{file: {file.name}, step: {record.step}, locked: {list(record.locked)}, "
            f"repeat: {record.repeat}}}"
        )
    manifest = folder / "manifest.yaml"
    manifest.write_text("\n".join(lines) + "\n")
    import_records(manifest, folder / "run")
    return folder / "run"


@pytest.mark.parametrize(
    ("method", "word"),
    [
        ("sequential", "every step by itself"),
        ("pso", "lost: pressure outside 0..supply"),
        ("simultaneous", "records used"),
    ],
)
def test_identify_by_another_method_from_the_command_line(
    method: str, word: str, run_folder: Path
) -> None:
    shown = bramah_here(
        "identify", run_folder, "--method", method, "--evaluations", 40, "--seed", 7
    )
    assert shown.returncode == 0, shown.stderr
    assert word in shown.stdout
