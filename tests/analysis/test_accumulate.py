"""Rows and records that stream through, against everything in memory at once."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import lstsq

from analysis.identify.identify import identify
from analysis.identify.reduction import reduce_rows, solve_reductions
from analysis.identify.result import PLAIN, Identification
from analysis.identify.stacked_rows import build_rows
from analysis.identify.streams.out_of_core import RecordTask, identify_folders, reduce_record
from analysis.regression.chunks import InMemory, source_rows
from analysis.regression.rows import default_filtering, paper_filtering
from analysis.regression.solve import Accumulator, triangle
from analysis.signals.locks import held_positions, motion_bands
from analysis.terms import baseline
from analysis.terms.base import Used
from rig.model.records import Record, Run
from rig.model.rig import Rig
from rig.runs.archive import write_run
from rig.runs.store import load_run
from rig.runs.stream import iterate_records, open_record, read_run_head
from tests.variants import kept

TERMS = tuple(Used(term) for term in baseline())


def test_blocks_folded_one_by_one_solve_what_all_rows_at_once_solve() -> None:
    rng = np.random.default_rng(0)
    X = rng.standard_normal((50_000, 9)) * np.logspace(6, -6, 9)
    y = X @ np.logspace(-6, 6, 9) + 0.01 * rng.standard_normal(len(X))
    edges = [0, 1, 5, 4101, 4102, 30_000, 50_000]
    whole = Accumulator(9)
    for a, b in pairwise(edges):
        whole.fold(X[a:b], y[a:b])
    R = whole.triangle
    assert whole.rows == 50_000
    assert np.linalg.solve(R[:9, :9], R[:9, 9]) == pytest.approx(lstsq(X, y)[0], rel=1e-10)
    residual = np.linalg.norm(y - X @ lstsq(X, y)[0])
    assert abs(R[9, 9]) == pytest.approx(residual, rel=1e-10)


@settings(max_examples=40)
@given(
    sizes=st.lists(st.integers(0, 70), min_size=1, max_size=8),
    block=st.integers(1, 64),
    columns=st.integers(1, 6),
)
def test_any_cut_of_the_rows_gives_the_same_normal_matrix(
    sizes: list[int], block: int, columns: int
) -> None:
    rng = np.random.default_rng(sum(sizes))
    parts = [(rng.standard_normal((m, columns)), rng.standard_normal(m)) for m in sizes]
    one, other = Accumulator(columns, block), Accumulator(columns)
    for matrix, rhs in parts:
        one.fold(matrix, rhs)
    for matrix, rhs in reversed(parts):
        other.merge(triangle(matrix, rhs), len(rhs))
    every = np.vstack([np.column_stack(part) for part in parts])
    for R in (one.triangle, other.triangle):
        assert pytest.approx(every.T @ every, abs=1e-9) == R.T @ R
        assert not np.tril(R, -1).any()
    assert one.rows == other.rows == sum(sizes)


def test_rows_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match="need 3 columns"):
        Accumulator(3).fold(np.ones((5, 2)), np.ones(5))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, multisine_run: Run) -> Path:
    return write_run(tmp_path_factory.mktemp("runs") / "monday", multisine_run)


def assert_same(one: Identification, other: Identification, tolerance: float = 1e-10) -> None:
    """Same values, standard errors, intervals, conditioning and counts."""
    assert list(one.estimates) == list(other.estimates)
    for name, a in one.estimates.items():
        b = other.estimates[name]
        found, expected = (a.value, a.std, *a.ci95), (b.value, b.std, *b.ci95)
        assert found == pytest.approx(expected, rel=tolerance, nan_ok=True), name
    assert one.rows == other.rows
    assert one.masked_rows == other.masked_rows
    assert [c.ok for c in one.checks] == [c.ok for c in other.checks]


def test_streamed_folders_give_what_all_rows_in_memory_give(
    folder: Path, multisine_run: Run, rig: Rig
) -> None:
    streamed = identify_folders([str(folder)])
    assert_same(streamed, identify([multisine_run], estimator=PLAIN))
    # An independent route: every row of every record stacked, solved by LAPACK's gelsy.
    per_record = build_rows(rig, [multisine_run], TERMS)
    for family, solution in solve_reductions(
        rig, TERMS, reduce_rows(rig, TERMS, per_record)
    ).items():
        found = streamed.solutions[family]
        every = [r for one in per_record for r in one.rows.values() if r.names == found.names]
        X = np.vstack([r.matrix for r in every])
        scale = np.linalg.norm(X, axis=0)
        y = np.concatenate([r.rhs for r in every])
        expected = lstsq(X / scale, y, lapack_driver="gelsy")[0] / scale
        assert found.value == pytest.approx(expected, rel=1e-10)
        assert found.covariance == pytest.approx(solution.covariance, rel=1e-8)


def test_one_record_is_in_memory_at_a_time(folder: Path, multisine_run: Run) -> None:
    stream = iterate_records(folder)
    assert isinstance(stream, Iterator)
    for record, expected in zip(stream, load_run(folder).records, strict=True):
        assert record.name == expected.name
        assert record.lines == expected.lines
        assert np.array_equal(record.channels["piston_1"], expected.channels["piston_1"])
    head = read_run_head(folder)
    assert [h.samples for h in head.records] == [10_000] * len(multisine_run.records)
    with open_record(folder, head.records[3].name) as reader:
        part = reader.read(2000, 2100)
        whole = multisine_run.records[3].channels["rod_pressure_2"]
        assert np.array_equal(part.channels["rod_pressure_2"], whole[2000:2100])


def long_record(run: Run, step: str) -> Record:
    """All repeats of a step put end to end, as one long record."""
    records = [r for r in run.records if r.step == step]
    channels = {
        name: np.concatenate([r.channels[name] for r in records]) for name in records[0].channels
    }
    return replace(records[0], channels=channels)


@pytest.mark.parametrize("filtering", [default_filtering, paper_filtering])
@pytest.mark.parametrize("stretch", kept([3_001, 12_000], (0,)))
def test_a_long_record_in_stretches_has_the_rows_of_the_whole(
    multisine_run: Run, rig: Rig, filtering: object, stretch: int
) -> None:
    record = long_record(multisine_run, "step2")
    p = record.channels["cap_pressure_1"].copy()
    p[5_980:6_040] = rig.sensors.chamber_pressure.range[1]  # clipped across a cut
    lost = {name: x.copy() for name, x in record.channels.items()} | {"cap_pressure_1": p}
    for x in lost.values():
        x[11_990:12_100] = np.nan  # and a block lost across another
    record = replace(record, channels=lost)
    filters = filtering(record)  # type: ignore[operator]
    source = InMemory(record)
    bands = motion_bands(rig, [record])
    (whole,) = source_rows(rig, TERMS, source, filters, bands)
    parts = list(source_rows(rig, TERMS, source, filters, bands, stretch))
    assert len(parts) == -(-40_000 // stretch)
    for name, rows in whole.items():
        found = [part[name] for part in parts]
        assert np.concatenate([r.time for r in found]) == pytest.approx(rows.time, abs=1e-9)
        assert sum(r.masked for r in found) == rows.masked > 0
        matrix = np.vstack([r.matrix for r in found])
        size = np.abs(rows.matrix).max(axis=0)
        assert (np.abs(matrix - rows.matrix).max(axis=0) <= 1e-10 * size).all()


def test_long_records_reduce_to_the_same_solution(multisine_run: Run, rig: Rig) -> None:
    """Standard errors too: they come from parts of the record, which do not move."""
    records = [long_record(multisine_run, step) for step in ("step1", "step2", "step3")]
    runs = [Run(rig, tuple(records))]
    whole, cut = (
        solve_reductions(
            rig,
            TERMS,
            [
                reduce_record(
                    RecordTask(
                        rig, 0, "", r.name, TERMS, default_filtering, False, stretch=stretch
                    ),
                    InMemory(r),
                )
                for r in runs[0].records
            ],
        )
        for stretch in (10**6, 7_000)
    )
    for family, one in whole.items():
        assert cut[family].value == pytest.approx(one.value, rel=1e-10)
        assert np.diag(cut[family].covariance) == pytest.approx(np.diag(one.covariance), rel=1e-8)
        assert cut[family].rows == one.rows


def test_a_lock_that_gives_slowly_has_the_rows_of_the_whole_in_stretches(
    multisine_run: Run, rig: Rig
) -> None:
    """Its wide filter depends on more samples on either side of a stretch than the others."""
    record = long_record(multisine_run, "step1")
    t = np.arange(record.samples) / record.sample_rate
    slow = record.channels["piston_1"] + 50e-6 * np.sin(2 * np.pi * 1.7 * t)
    record = replace(record, channels={**record.channels, "piston_1": slow})
    bands, filters = motion_bands(rig, [record]), default_filtering(record)
    assert 0.0 < bands[0] < bands[1]
    (whole,) = source_rows(rig, TERMS, InMemory(record), filters, bands)
    parts = list(source_rows(rig, TERMS, InMemory(record), filters, bands, 12_000))
    for name, rows in whole.items():
        matrix = np.vstack([part[name].matrix for part in parts])
        size = np.abs(rows.matrix).max(axis=0)
        assert (np.abs(matrix - rows.matrix).max(axis=0) <= 1e-10 * size).all()


def test_what_a_lock_does_is_found_in_stretches_too(multisine_run: Run, rig: Rig) -> None:
    record = long_record(multisine_run, "step1")
    t = np.arange(record.samples) / record.sample_rate
    shaken = record.channels["piston_1"] + 20e-6 * np.sin(2 * np.pi * 8 * t)
    for piston, gives in ((record.channels["piston_1"], False), (shaken, True)):
        whole = replace(record, channels={**record.channels, "piston_1": piston})
        assert (motion_bands(rig, [whole]) > 0).tolist() == [gives, True]
        parts = [InMemory(whole).read(a, a + 6_000) for a in range(0, whole.samples, 6_000)]
        expected = held_positions(rig, [whole])
        assert held_positions(rig, parts) == pytest.approx(expected, rel=1e-12)
