"""The report's parts, each against an independent route."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from analysis.identify.identify import identify
from analysis.identify.stacked_rows import RecordRows, build_rows
from analysis.regression.conditioned import ConditionedRecord
from analysis.regression.rows import Rows
from analysis.report import format as fm
from analysis.report import paper
from analysis.report.identification import facts
from analysis.report.identification.report import render_report
from analysis.report.plots import arm_plot, record_plots, style, trace_plots
from analysis.report.residuals import per_repeat, residuals
from analysis.terms import make, with_effects
from analysis.terms.base import Used
from analysis.trace.result import Curve, JudgedEffect
from rig.model.parameters import parameter_names
from rig.model.records import Record, Run
from rig.model.rig import Rig
from rig.runs.rigs import load_rig
from tests.analysis.page import Page, number
from tests.studies.machines import electric_plant

FINITE = st.floats(1e-12, 1e12) | st.floats(-1e12, -1e-12)


@given(FINITE, st.integers(2, 5))
def test_significant_digits_are_right_to_half_of_the_last(value: float, digits: int) -> None:
    shown = number(fm.significant(value, digits))
    place = 10.0 ** (math.floor(math.log10(abs(value))) - digits + 1)
    assert abs(shown - value) <= 0.5001 * place + 1e-12 * abs(value)


@given(FINITE, st.floats(1e-6, 10.0))
def test_a_value_is_written_as_finely_as_its_interval_deserves(
    value: float, relative: float
) -> None:
    half = relative * abs(value)
    places = fm.decimals(value, half)
    shown = number(fm.fixed(value, places))
    leading = math.floor(math.log10(abs(value)))
    assert abs(shown - value) <= 0.5001 * 10.0**-places + 1e-12 * abs(value)
    if places:
        # Never coarser than three digits or than a third of the interval, within six digits.
        assert places >= 2 - leading
        assert places <= max(5 - leading, 0)
        if places < 5 - leading:
            assert 10.0**-places <= 1.001 * half


def test_what_does_not_exist_is_a_dash_and_nothing_is_minus_zero() -> None:
    assert fm.significant(float("nan")) == fm.fit(None) == fm.DASH
    assert fm.significant(float("inf")) == "∞"
    assert fm.fixed(-0.0001, 2) == "0.00"
    assert fm.fit(-1.0e4) == "−10000"
    assert fm.column_percent(0.00032, signed=True) == "0.000"
    assert fm.folder_name("/home/me/runs/a") == fm.folder_name("C:\\runs\\a") == "a"


def test_the_papers_numbers_cover_the_model_and_are_ordered() -> None:
    assert set(paper.TABLE_III) == set(parameter_names(2))
    for row in paper.TABLE_III.values():
        assert row.low <= row.mean <= row.high
        # Three standard deviations either way hold ten experiments' extremes and little more.
        assert (row.high - row.low) / row.mean < 6 * row.rsd / 100 * 1.01
    assert paper.TABLE_III["b"].mean == 233e6
    assert paper.TABLE_III["C_pp_2"].ga == pytest.approx(6.76e-7)


def test_a_thinned_trace_keeps_its_one_spike() -> None:
    x = np.linspace(0, 1, 50_000)
    y = np.sin(40 * x)
    y[31_234] = 9.0
    tx, ty = style.thin(x, y, 300)
    assert len(tx) <= 310
    assert ty.max() == 9.0
    assert (np.diff(tx) > 0).all()
    assert (tx[0], tx[-1]) == (0.0, 1.0)


def test_no_line_is_drawn_over_a_gap() -> None:
    t = np.array([0.0, 0.1, 0.2, 0.9, 1.0])
    x, y = style.gapped(t, np.ones(5))
    assert np.isnan(y).sum() == 1
    assert np.isnan(y[3])
    assert len(x) == 6


def test_the_line_spectrum_shows_amplitudes_in_volts() -> None:
    n, period = 2500, 1000
    t = np.arange(n) / 1000.0
    x = 0.3 * np.sin(2 * np.pi * 3 * t + 0.4) + 0.01 * np.cos(2 * np.pi * 4 * t) + 5.0
    record = Record("a", "a", (), 1, 1000.0, {"spool_1": x}, period=period, lines=(3, 5))
    lines = record_plots.line_spectrum(record, x)
    assert lines is not None
    by_frequency = dict(zip(lines.frequency.round(9), lines.amplitude, strict=True))
    assert by_frequency[3.0] == pytest.approx(0.3, rel=1e-9)
    assert by_frequency[4.0] == pytest.approx(0.01, rel=1e-9)
    assert by_frequency[5.0] < 1e-12
    assert list(lines.frequency[lines.excited]) == [3.0, 5.0]
    assert record_plots.line_spectrum(replace(record, period=0), x) is None


@given(st.lists(st.floats(-0.5, 0.5), min_size=2, max_size=2))
def test_pins_of_the_drawing_are_a_cylinders_length_apart(strokes: list[float]) -> None:
    rig = _rig()
    pistons = [f * j.cylinder.stroke for f, j in zip(strokes, rig.joints, strict=True)]
    q = np.array([float(j.linkage.angle(s)) for s, j in zip(pistons, rig.joints, strict=True)])
    at = arm_plot.pose(rig, q)
    for k, joint in enumerate(rig.joints):
        length = float(np.linalg.norm(at.outer[k] - at.inner[k]))
        assert length == pytest.approx(joint.linkage.mid_length + pistons[k], abs=1e-9)
        link = float(np.linalg.norm(at.joints[k + 1] - at.joints[k]))
        assert link == pytest.approx(joint.link_length)


def _rig() -> Rig:
    from tests.analysis.small_bench import shinshu

    return shinshu()


def test_noise_and_model_error_are_told_apart(multisine_run: Run) -> None:
    """To real rows a known repeatable error and known noise are added."""
    found = identify([multisine_run])
    clean = build_rows(multisine_run.rig, [multisine_run], found.model.terms)
    rng = np.random.default_rng(3)
    quiet = []
    for one in clean:
        rows = {}
        for name, r in one.rows.items():
            beta = found.solutions["mechanical" if "torque" in name else "fluid"].value
            error = 2.0 * np.sin(2 * np.pi * 3.0 * r.time) + 5.0 * rng.standard_normal(len(r.time))
            rows[name] = replace(r, rhs=r.matrix @ beta + error)
        quiet.append(replace(one, rows=rows))
    for one_residual in residuals(found, quiet):
        assert one_residual.repeats == 4
        assert one_residual.scatter == pytest.approx(5.0, rel=0.1)
        assert one_residual.repeatable == pytest.approx(2.0 / math.sqrt(2), rel=0.35)
        assert one_residual.rms == pytest.approx(math.sqrt(25 + 2), rel=0.1)
        # The line at 3 Hz stands above what scatter leaves in the mean; elsewhere it does not.
        ratio = one_residual.spectrum / (one_residual.spectrum_scatter / 2)
        peak = int(np.argmax(ratio))
        assert one_residual.frequency[peak] == pytest.approx(3.0, abs=0.3)


def test_masked_rows_leave_the_scatter_where_it_was() -> None:
    rng = np.random.default_rng(0)
    t = np.arange(2000) * 0.02
    kept = (t % 10) < 6

    def one(repeat: int) -> RecordRows:
        rows = Rows("torque_1", ("M1",), np.ones((int(kept.sum()), 1)),
                    7.0 + rng.standard_normal(int(kept.sum())), t[kept],
                    int((~kept).sum()))  # fmt: skip
        record = Record(f"a_r{repeat}", "a", (), repeat, 1000.0, {})
        conditioned = ConditionedRecord(0, record, None, None)  # type: ignore[arg-type]
        return RecordRows(conditioned, {"torque_1": rows})

    class _Solution:
        names = ("Fv1",)
        value = np.array([7.0])

    class _Model:
        rig = load_rig("boom-1dof")
        terms = (Used(make("viscous_friction")),)

    class _Found:
        model = _Model()
        solutions = {"mechanical": _Solution()}  # noqa: RUF012

    (found,) = residuals(_Found(), [one(1), one(2), one(3), one(4)])  # type: ignore[arg-type]
    # White noise of 1 spread over 25 Hz.
    assert np.median(found.spectrum_scatter) == pytest.approx(1 / math.sqrt(25), rel=0.1)
    assert found.masked == 4 * int((~kept).sum())


def test_each_repeat_alone_gives_what_identifying_it_alone_gives(multisine_run: Run) -> None:
    found = identify([multisine_run], estimator="plain")
    rows = build_rows(multisine_run.rig, [multisine_run], found.model.terms)
    scatter = per_repeat(found, rows)
    alone = [
        identify(
            [
                replace(
                    multisine_run, records=tuple(r for r in multisine_run.records if r.repeat == k)
                )
            ],
            estimator="plain",
        )
        for k in range(1, 5)
    ]
    for name, spread in scatter.items():
        values = [a.estimates[name].value for a in alone]
        assert spread.repeats == 4
        assert (spread.low, spread.high) == pytest.approx((min(values), max(values)), rel=1e-9)
        assert spread.rsd == pytest.approx(100 * np.std(values, ddof=1) / np.mean(values), rel=1e-6)
    assert per_repeat(found, [r for r in rows if r.record.repeat == 1]) == {}


@pytest.fixture(scope="module")
def sloped_arm() -> Run:
    """The electric arm on a base whose slope its rig file leaves unknown."""
    arm = electric_plant.draw_arm(np.random.default_rng(5))
    rig = load_rig("electric-2dof")
    return electric_plant.records(rig, arm, np.random.default_rng(6), repeats=2)


@pytest.mark.parametrize(("bench", "effects"), [
    ("multisine_run", ["base_inclination"]),
    ("sloped_arm", []),
])  # fmt: skip
def test_the_report_of_an_unknown_slope_has_the_residuals_of_that_slope(
    bench: str, effects: list[str], request: pytest.FixtureRequest
) -> None:
    """2 N weights and one angle determine 2 N columns: the rows of gravity turned by the angle."""
    run: Run = request.getfixturevalue(bench)
    found = identify([run], terms=[Used(term) for term in with_effects(run.rig, effects)])
    values = {name: estimate.value for name, estimate in found.estimates.items()}
    known = [used for used in found.model.terms if used.term.name != "inclined_gravity"]
    known += [
        Used(make("gravity")),
        Used(make("base_inclination"), (values["base_inclination"],)),
    ]
    squares: dict[tuple[str, str], list[np.ndarray]] = {}
    for record in build_rows(run.rig, [run], known):
        for r in record.family("mechanical"):
            left = r.rhs - r.matrix @ [values[name] for name in r.names]
            squares.setdefault((record.record.step, r.equation[-1]), []).append(left**2)
    page = Page(render_report(runs=[run], identification=found))
    table = page.table("Residuals of the equations")
    shown = {(row[0], row[1]): number(row[5]) for row in table.rows if "N·m" in row}
    assert shown == {
        place: pytest.approx(math.sqrt(np.concatenate(parts).mean()), rel=6e-3)
        for place, parts in squares.items()
    }
    alone = per_repeat(found, found.built)["base_inclination"]
    assert alone.mean == pytest.approx(values["base_inclination"], abs=2e-3)


def test_a_bench_that_is_no_rigid_body_is_told_from_a_bad_identification() -> None:
    rig = _rig()
    said = facts.truth_remark(rig, {"R12": 1.37, "W2": 3.30})
    assert "R12/W2 = 0.415 m for a link of 0.500 m" in said
    assert facts.truth_remark(rig, {"R12": 1.65, "W2": 3.30}) == ""
    assert facts.truth_remark(rig, None) == ""


def test_a_curve_is_drawn_with_its_band_and_its_units() -> None:
    x = np.linspace(0.0, 0.2, 9)
    lines = tuple(Curve(way, x, 80 + x, 70 + x, 90 + x, "m/s", "N") for way in ("out", "back"))
    found = JudgedEffect(
        "friction_curve", "joint 1", {}, 0.005, 0.9, (), (), "the piston's velocity",
        mechanism="friction_curve", free=True, curves=lines,
    )  # fmt: skip
    drawn = str(trace_plots.curves(found, "c0"))
    for said in ("friction curve with its 95 % band", "velocity [m/s]", "[N]", "out", "back"):
        assert said in drawn
