"""The page of a night, read as a browser would."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from analysis.report.night import Night, NightEstimate, NightItem, change, render
from tests.analysis.page import Page

BEGIN = datetime(2026, 3, 1, 22, 0, tzinfo=UTC)


def item(number: int, state: str, reason: str = "", b: float | None = None) -> NightItem:
    ran = state != "queued"
    start = BEGIN + timedelta(minutes=20 * number)
    return NightItem(
        number, f"job <{number}>", state, reason, "shinshu-2dof", f"/runs/{number}",
        start if ran else None, start + timedelta(minutes=12) if ran else None, int(ran),
        4 if ran else -1, 40_000 if ran else -1, 3 if ran else -1, 43.0 if ran else -1.0,
        {} if b is None else {"b": NightEstimate(b, 0.01 * b, "Pa"),
                              "M1": NightEstimate(2.0, 0.1, "kg*m^2")},
    )  # fmt: skip


@pytest.fixture
def page() -> Page:
    items = (
        item(1, "done", b=7.0e8),
        item(2, "failed", "joint 2 gave 3.1 mm"),
        item(3, "done", b=7.7e8),
        item(4, "tripped", "cap_pressure_1 9.31 MPa"),
        item(5, "queued"),
    )
    notes = ((BEGIN, "runner begins: process 4"),)
    return Page(render(Night("/data/queue.sqlite", "bench-pc", BEGIN, items, notes)))


def test_the_page_says_what_ran_what_tripped_and_what_waits(page: Page) -> None:
    assert "2 of 5 items completed; 1 failed, 1 tripped, 1 queued." in page.text
    assert "Tripped in item 4, job <4>: cap_pressure_1 9.31 MPa" in page.text
    rows = page.table("Items").rows
    assert [row[2] for row in rows if row[0].isdigit()] == [
        "done", "failed", "done", "tripped", "queued",
    ]  # fmt: skip
    assert page.table("Items").row("2")[3] == "joint 2 gave 3.1 mm"
    assert "16 complete records" in page.text
    assert "12 samples lost" in page.text
    # As the samples say: the host's clock may be set between an item's start and its end.
    assert page.table("Items").row("3")[-5:-1] == ["0.7", "4", "40000", "3"]
    assert "runner begins: process 4" in page.text


def test_every_parameter_s_drift_stands_in_its_table_and_plot(page: Page) -> None:
    table = page.table("shinshu-2dof: 2 runs")
    b = table.row("b")
    assert b[1:3] == ["700.0", "770.0"]
    assert "+10" in b[5]
    assert float(b[6]) == pytest.approx(0.7e8 / np.hypot(7e6, 7.7e6), rel=0.02)
    assert table.row("M1")[7] == "2"


def test_the_page_needs_nothing_from_elsewhere(page: Page) -> None:
    assert page.references == [r for r in page.references if r.startswith("#")]
    assert not {"script", "link", "img", "iframe"} & set(page.elements)


def test_an_empty_night_is_a_page_too() -> None:
    text = Page(render(Night("q", "pc", BEGIN, ()))).text
    assert "No item has run." in text
    assert "No run was identified." in text


def test_a_change_is_judged_by_both_errors() -> None:
    rng = np.random.default_rng(1)
    draws = [
        change([NightEstimate(x, 1.96 * 2.0, ""), NightEstimate(y, 1.96, "")])[1]
        for x, y in zip(rng.normal(5, 2, 4000), rng.normal(5, 1, 4000), strict=True)
    ]
    # Nothing drifted: one change in twenty exceeds its 95 % error.
    assert np.mean(np.abs(draws) > 1.0) == pytest.approx(0.05, abs=0.015)
    assert change([NightEstimate(1.0, float("nan"), ""), NightEstimate(2.0, 0.1, "")]) == (1.0, 0.0)
