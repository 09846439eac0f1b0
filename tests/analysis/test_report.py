"""A colleague is sent the report: what it says is what was computed, and it stands alone."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import matplotlib as mpl
import pytest

from analysis.identify.checks import Check
from analysis.identify.identify import identify
from analysis.identify.result import Identification
from analysis.report.identification.report import Provenance, render_report
from analysis.report.page import write
from analysis.simulation.validate import RecordValidation, validate
from rig.model.parse import InputError
from rig.model.records import Run
from rig.model.rig import Rig
from tests.analysis import small_bench as bench
from tests.analysis.page import Page, number

SCALE = {"MPa": 1e-6, "10⁻⁷ m³/(s·V·√Pa)": 1e7}
HOSTILE = '<script>alert("x")</script>&amp;$\\frac{1}{2}$\'"油'


@pytest.fixture(scope="module")
def found(multisine_run: Run) -> Identification:
    return identify([multisine_run])


@pytest.fixture(scope="module")
def brief(multisine_run: Run) -> Run:
    """One record of a step, where the page's other parts are looked at."""
    return replace(multisine_run, records=multisine_run.records[:1])


@pytest.fixture(scope="module")
def sine_validation(rig: Rig) -> Run:
    """Two records named as columns of the paper's Table IV, and both joints at once."""
    steps = (
        bench.Step("step1_1hz", (1,), (0.0, 0.0)),
        bench.Step("step2_3hz", (2,), (0.0, -0.0374)),
        bench.Step("both_1hz", (), (0.0, 0.0)),
    )
    waves = {
        "step1_1hz": {1: bench.Excitation.sine(0.05)},
        "step2_3hz": {0: bench.Excitation.sine(0.05, 3.0)},
        "both_1hz": {0: bench.Excitation.sine(0.03), 1: bench.Excitation.sine(0.03)},
    }
    run = bench.experiment(rig, waves, repeats=1, seed=5, steps=steps, seconds=3.0)
    return replace(run, source="/home/someone/secret/runs/2025-validate")


@pytest.fixture(scope="module")
def validated(found: Identification, sine_validation: Run) -> list[RecordValidation]:
    return validate(found.model, [sine_validation])


@pytest.fixture(scope="module")
def html(
    multisine_run: Run,
    found: Identification,
    sine_validation: Run,
    validated: list[RecordValidation],
) -> str:
    return render_report(
        runs=[replace(multisine_run, source="C:\\Users\\me\\2025-multisine")],
        identification=found,
        validation=validated,
        validation_runs=[sine_validation],
        truth=bench.TRUTH,
        title="An arm and its sixteen numbers",
        provenance=Provenance(
            date="12 November 2025",
            commands=("bramah demo --out 'a & b'",),
            versions={"numpy": "2.0"},
            seeds={"plant": 7},
        ),
    )


@pytest.fixture(scope="module")
def page(html: str) -> Page:
    return Page(html)


def test_every_parameter_stands_there_with_its_interval_and_its_error(
    page: Page, found: Identification
) -> None:
    table = page.table("Parameters")
    for name, estimate in found.estimates.items():
        _, _, value, unit, interval, rsd, nominal, truth, error, held, paper = table.row(name)
        scale = SCALE.get(unit, 1.0)
        shown, half = value.split(" ± ")
        assert number(shown) == pytest.approx(scale * estimate.value, rel=5e-4)
        low, high = (number(end) for end in interval.split(" … "))
        width = scale * (estimate.ci95[1] - estimate.ci95[0])
        assert high - low == pytest.approx(width, rel=0.35)
        assert number(half) == pytest.approx(width / 2, rel=0.35)
        assert number(rsd) == pytest.approx(100 * estimate.std / estimate.value, abs=1e-3, rel=1e-2)
        true = bench.TRUTH[name]
        assert number(truth) == pytest.approx(scale * true, rel=2e-3)
        assert number(paper) == pytest.approx(scale * true, rel=2e-3)  # this bench IS the paper's
        assert number(error) == pytest.approx(100 * (estimate.value / true - 1), abs=6e-3)
        assert (held == "yes") == (estimate.ci95[0] <= true <= estimate.ci95[1])
        assert number(nominal) == pytest.approx(scale * found.model.rig.nominal[name], rel=1e-3)


def test_the_first_sentences_count_what_was_given(
    page: Page, validated: list[RecordValidation]
) -> None:
    assert "12 records of 3 steps were taken, 2 minutes of data" in page.text
    assert "gives 16 of the 16 parameters" in page.text
    assert "compared with 3 records never used for the fit" in page.text
    worst = min(v for r in validated for v in r.fit.values())
    assert f"the worst FIT of any channel is {worst:.1f} %" in page.text
    assert "Simulated bench: the truth is known" in page.text


def test_every_check_is_named_with_its_state(page: Page, found: Identification) -> None:
    for name in {check.name for check in found.checks}:
        ok = all(check.ok for check in found.checks if check.name == name)
        assert f"{'ok' if ok else 'not ok'} {name} :" in page.text
    for check in found.checks:
        assert check.detail in page.text


def test_validation_table_and_table_four_hold_the_fit(
    page: Page, validated: list[RecordValidation]
) -> None:
    table = page.table("Validation")
    row = table.row("step1_1hz_r1")
    fit = validated[0].fit
    wanted = [fit[f"{kind}_2"] for kind in ("piston", "cap_pressure", "rod_pressure")]
    assert [number(v) for v in row[2:5]] == pytest.approx(wanted, abs=0.05)
    assert number(row[5]) == pytest.approx(1e3 * validated[0].rmse["piston_2"], rel=6e-3)
    four = page.table("Table IV")
    assert four.row("step1_1hz")[3::3] == ["91.7", "33.6", "35.1"]
    assert "6 of 6 cells lie above the paper" in page.text
    assert four.row("both_1hz")[3] == "—"


WHY = "the state diverged 0.500 s after the start"


@pytest.fixture(scope="module")
def bad_results(validated: list[RecordValidation]) -> list[RecordValidation]:
    """A record with a low FIT, and one whose simulation failed."""
    worse = replace(
        validated[0], fit={"piston_2": 50.0, "cap_pressure_2": 40.0, "rod_pressure_2": -2e4}
    )
    ended = replace(validated[2].simulation, filled=500)
    return [worse, replace(validated[2], failure=WHY, simulation=ended)]


@pytest.fixture(scope="module")
def bad_html(
    brief: Run, found: Identification, bad_results: list[RecordValidation]
) -> str:  # the spool's record is not given either
    return render_report(runs=[brief], identification=found, validation=bad_results)


def test_a_cell_below_the_paper_is_marked_below(bad_html: str) -> None:
    page = Page(bad_html)
    row = page.table("Table IV").row("step1_1hz")
    assert row[2:11] == [
        "50.0", "91.7", "▼ below", "40.0", "33.6", "▲ above", "−20000", "35.1", "▼ below",
    ]  # fmt: skip
    assert "1 of 3 cells lie above the paper" in page.text


def test_a_simulation_that_failed_is_said_aloud(bad_html: str) -> None:
    page = Page(bad_html)
    assert f"failed: {WHY}" in page.table("Validation").row("both_1hz_r1")[-1]
    assert "1 free runs that failed" in page.text


@pytest.fixture(scope="module")
def fitted_again(brief: Run, found: Identification) -> list[RecordValidation]:
    return validate(found.model, [brief])


def test_validating_on_the_fitted_records_is_admitted(
    brief: Run, found: Identification, fitted_again: list[RecordValidation]
) -> None:
    again = replace(brief, source="copied")
    page = Page(
        render_report(
            runs=[brief], identification=found, validation_runs=[again], validation=fitted_again
        )
    )
    assert "of which 1 had also been used for the fit" in page.text


def test_the_page_stands_alone(html: str, page: Page) -> None:
    assert len(html) < 6e6
    assert page.elements.count("svg") > 10
    assert not {"script", "link", "img", "iframe", "object", "embed", "base"} & set(page.elements)
    assert all(r.startswith("#") for r in page.references)
    assert {r[1:] for r in page.references} <= set(page.ids)
    assert len(set(page.ids)) == len(page.ids)
    assert "http" not in html
    assert "@import" not in html
    assert "secret" not in html
    assert "Users" not in html
    assert {row[0] for row in page.table("Provenance").rows} >= {"2025-multisine", "2025-validate"}
    assert "bramah demo --out 'a & b'" in page.text


def test_the_same_arguments_give_the_same_bytes_and_leave_matplotlib_alone(
    brief: Run, found: Identification, bad_results: list[RecordValidation], bad_html: str
) -> None:
    before = dict(mpl.rcParams)
    again = render_report(runs=[brief], identification=found, validation=bad_results)
    assert again == bad_html
    assert dict(mpl.rcParams) == before


def test_hostile_names_stay_text(
    multisine_run: Run, found: Identification, fitted_again: list[RecordValidation]
) -> None:
    rig = multisine_run.rig.model_copy(
        update={
            "description": HOSTILE,
            "joints": tuple(
                joint.model_copy(update={"name": HOSTILE}) for joint in multisine_run.rig.joints
            ),
        }
    )
    records = tuple(
        replace(
            r, name=HOSTILE + r.name, step=HOSTILE + r.step,
            attributes={"lock_1": HOSTILE, "lost_samples": HOSTILE},
        )
        for r in multisine_run.records[:1]
    )  # fmt: skip
    run = replace(multisine_run, rig=rig, records=records, source=HOSTILE)
    model = replace(found.model, rig=rig)
    bad = replace(found, model=model, checks=(Check(HOSTILE, False, HOSTILE),))
    results = [replace(v, record=HOSTILE, step=HOSTILE) for v in fitted_again]
    html = render_report(
        runs=[run], identification=bad, validation=results, validation_runs=[run], title=HOSTILE,
        provenance=Provenance(
            HOSTILE, (HOSTILE,), {HOSTILE: HOSTILE}, {HOSTILE: HOSTILE}, (HOSTILE,)
        ),
    )  # fmt: skip
    page = Page(html)
    assert "script" not in page.elements
    assert "alert" in page.text
    assert page.text.count('<script>alert("x")') >= 10
    assert len(set(page.ids)) == len(page.ids)


def test_an_import_of_another_rig_with_one_repeat_and_no_truth_says_what_is_missing(
    multisine_run: Run,
) -> None:
    rig = multisine_run.rig.model_copy(update={"name": "yard-crane", "nominal": {}})
    records = tuple(
        replace(r, attributes={}, period=0, lines=())
        for r in multisine_run.records
        if r.repeat == 1
    )
    run = Run(rig, records, source="csv")
    page = Page(render_report(runs=[run], identification=identify([run])))
    assert "not been validated" in page.text
    assert "No validation records were given" in page.text
    assert "yard-crane is another rig" in page.text
    assert "The truth is not known" in page.text
    assert "noise and model error cannot be separated" in page.text
    assert "not periodic" in page.table("Steps recorded for the identification").row("step1")[5]
    assert page.table("Residuals of the equations").row("step1")[7:9] == ["—", "—"]


def test_what_cannot_be_identified_is_named_and_not_drawn_as_a_number(multisine_run: Run) -> None:
    run = replace(
        multisine_run, records=tuple(r for r in multisine_run.records if r.step == "step1")
    )
    result = identify([run])
    page = Page(render_report(runs=[run], identification=result, truth=bench.TRUTH))
    lost = [name for name, e in result.estimates.items() if not e.identified]
    assert "Fv1" in lost
    for name in lost:
        row = page.table("Parameters").row(name)
        assert "not identifiable" in row[1]
        assert row[2] == "—"
    assert f"{16 - len(lost)} of the 16 parameters" in page.text


def test_one_joint_alone(multisine_run: Run) -> None:
    """Joint 1 with the arm as a fixed load: another rig of one joint."""
    old = multisine_run.rig
    rig = Rig(
        name="one-joint", sample_rate=old.sample_rate, supply=old.supply, oil=old.oil,
        joints=old.joints[:1], sensors=old.sensors,
    )  # fmt: skip
    records = tuple(
        replace(
            r, locked=(),
            channels={n: c for n, c in r.channels.items() if n in rig.channels},
        )
        for r in multisine_run.records if r.step == "step2"
    )  # fmt: skip
    run = Run(rig, records)
    result = identify([run])
    page = Page(
        render_report(
            runs=[run], identification=result,
            validation=validate(result.model, [run]), validation_runs=[run],
        )
    )  # fmt: skip
    assert "1 hydraulic joint)" in page.text
    assert page.table("Parameters").row("M1")[1] == "inertia about joint 1"
    assert page.table("Validation").row("step2_r1")[1] == "1"


def test_a_report_is_written_whole_and_one_that_cannot_be_says_where(
    tmp_path: Path, html: str
) -> None:
    path = tmp_path / "r.html"
    write(path, html)
    with pytest.raises(InputError, match=re.escape("cannot write the report")):
        write(path / "r.html", html)  # a file stands where the folder should
    assert path.read_text(encoding="utf-8").lstrip().startswith("<!DOCTYPE html>")
    assert [p.name for p in tmp_path.iterdir()] == ["r.html"]
