"""The running estimate against the batch's, a bulk modulus that jumps, and what is forgotten."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from analysis.identify.identify import identify
from analysis.identify.reduction import reduce_rows, solve_reductions
from analysis.identify.result import PLAIN
from analysis.identify.settings import IDENTIFY
from analysis.identify.stacked_rows import build_rows
from analysis.identify.streams.online import RowFeed, Tracker, _Filter, track
from analysis.regression.chunks import Locks, stretch_rows
from analysis.regression.rows import Rows, default_filtering
from analysis.terms import baseline
from analysis.terms.base import Used
from rig.model.parse import InputError
from rig.model.records import Record, RecordHead, Run, head_of
from rig.model.rig import Rig
from tests.analysis import small_bench as bench
from tests.analysis.small_bench import TRUTH

TERMS = tuple(Used(term) for term in baseline())
FLUID = [name for name in TRUTH if name == "b" or name.startswith("C")]


def test_at_the_end_it_is_the_batch_solution(multisine_run: Run, rig: Rig) -> None:
    tracker = Tracker(rig)
    for record in multisine_run.records:
        track(tracker, record)
    found, expected = tracker.estimates(), identify([multisine_run], estimator=PLAIN).estimates
    assert list(found) == FLUID
    for name, estimate in found.items():
        assert estimate.value == pytest.approx(expected[name].value, rel=1e-9), name
        assert estimate.std == pytest.approx(expected[name].std, rel=1e-8), name


def test_torque_rows_are_the_batch_s_of_joints_that_move_as_measured(
    multisine_run: Run, rig: Rig
) -> None:
    tracker = Tracker(rig, families=("mechanical",))
    stacked = []
    locks = Locks(np.full(2, np.inf), np.zeros(2))
    for record in multisine_run.records[::4]:
        track(tracker, record)
        own = (0, record.samples)
        rows = stretch_rows(rig, TERMS, record, 0, own, default_filtering(record), locks)
        stacked += [r for r in rows.values() if r.equation.startswith("torque")]
    X, y = np.vstack([r.matrix for r in stacked]), np.concatenate([r.rhs for r in stacked])
    expected = np.linalg.lstsq(X, y)[0]
    found = [e.value for e in tracker.estimates().values()]
    assert found == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("block", [1, 10, 333])
def test_rows_come_in_time_and_only_once(multisine_run: Run, rig: Rig, block: int) -> None:
    record = multisine_run.records[5]
    part = replace(record, channels={n: x[:3000] for n, x in record.channels.items()})
    filters = default_filtering(part)
    feed = RowFeed(rig, TERMS, head_of(part), filters, ("fluid",))
    times: list[float] = []
    for first in range(0, 3000, block):
        now = min(first + block, 3000) / 1000
        channels = {n: x[first : first + block] for n, x in part.channels.items()}
        found = feed.feed(channels).get("flow_cap_1")
        times += [] if found is None else list(found.time)
        newest = times[-1] if times else 0.0
        assert now - newest <= feed.delay + (filters.step + block) / 1000
    times += list(feed.finish()["flow_cap_1"].time)
    expected = build_rows(rig, [Run(rig, (part,))], TERMS)[0].rows["flow_cap_1"].time
    assert times == pytest.approx(expected, abs=1e-9)


def test_a_discarded_record_leaves_no_trace(multisine_run: Run, rig: Rig) -> None:
    first, second = multisine_run.records[0], multisine_run.records[1]
    once, twice = Tracker(rig), Tracker(rig)
    track(once, first)
    track(twice, first)
    twice.begin(head_of(second))
    twice.feed(second.channels)
    assert twice.estimates()["b"].value != once.estimates()["b"].value
    twice.discard()
    assert twice.estimates()["b"] == once.estimates()["b"]


def test_lost_samples_are_left_out_as_the_batch_does(multisine_run: Run, rig: Rig) -> None:
    record = multisine_run.records[0]
    channels = {name: x.copy() for name, x in record.channels.items()}
    for x in channels.values():
        x[4003:4013] = np.nan
    holed = replace(record, channels=channels)
    tracker = Tracker(rig)
    track(tracker, holed)
    expected = identify([Run(rig, (holed,))], estimator=PLAIN).estimates["b"].value
    assert tracker.estimates()["b"].value == pytest.approx(expected, rel=1e-9)


@pytest.fixture(scope="module")
def jump(rig: Rig) -> tuple[Record, Record]:
    """Twenty seconds of a joint; air gets into the oil between the two halves."""
    step = (bench.STEPS[0],)
    excitations = bench.default_excitations(3, 0.025)
    before, after = (
        bench.experiment(
            rig, excitations, repeats=1, seed=3, steps=step, truth={**TRUTH, "b": bulk}
        ).records[0]
        for bulk in (233e6, 180e6)
    )
    return before, replace(after, name="later", repeat=2, start=10.0)


def test_a_bulk_modulus_that_jumps_is_followed_within_the_memory(
    rig: Rig, jump: tuple[Record, Record]
) -> None:
    tracker, batch = Tracker(rig, memory=2.0), Tracker(rig)
    for record in jump:
        track(tracker, record)
        track(batch, record)
        if record is jump[0]:
            assert tracker.estimates()["b"].value == pytest.approx(233e6, rel=0.01)
    found = tracker.estimates()["b"]
    # Ten seconds are five memories: exp(-5) of the old value is left, and the interval knows.
    assert found.value == pytest.approx(180e6, rel=0.015)
    assert found.ci95[0] - 2e6 < 180e6 < found.ci95[1] + 2e6
    assert abs(batch.estimates()["b"].value / 180e6 - 1) > 0.05
    for name in ("C_pp_2", "C_mm_2"):
        assert tracker.estimates()[name].value == pytest.approx(TRUTH[name], rel=0.01)


def test_forgetting_weighs_rows_by_their_age(rig: Rig, jump: tuple[Record, Record]) -> None:
    """An independent route: weighted least squares of all rows at once."""
    memory = 3.0
    tracker = Tracker(rig, memory=memory)
    matrices, sides, ages = [], [], []
    for record in jump:
        track(tracker, record)
        for name, rows in build_rows(rig, [Run(rig, (record,))], TERMS)[0].rows.items():
            if name.startswith("flow"):
                matrices.append(rows.matrix)
                sides.append(rows.rhs)
                ages.append(record.start + rows.time)
    age = np.concatenate(ages)
    root = np.exp(0.5 * (age - age.max()) / memory)
    X, y = np.vstack(matrices) * root[:, None], np.concatenate(sides) * root
    used = np.linalg.norm(X, axis=0) > 0
    expected = np.linalg.lstsq(X[:, used], y)[0]
    found = np.array([e.value for e in tracker.estimates().values()])[used]
    expected[0] = 1.0 / expected[0]
    assert found == pytest.approx(expected, rel=1e-8)


def test_what_is_not_excited_is_held_not_lost(multisine_run: Run, rig: Rig) -> None:
    """Joint 1, then a long time only joint 2: after 30 memories joint 1's gains still stand."""
    by_step = {r.step: r for r in multisine_run.records}
    tracker = Tracker(rig, memory=1.0)
    track(tracker, replace(by_step["step2"], start=0.0))
    for k in range(4):
        track(tracker, replace(by_step["step1"], repeat=k + 1, start=10.0 + 10.0 * k))
    found = tracker.estimates()
    for name in FLUID:
        assert found[name].value == pytest.approx(TRUTH[name], rel=0.03), name
    for name in ("C_pp_1", "C_mm_1"):
        assert "held" in found[name].note
        assert np.isnan(found[name].std)
    assert found["b"].std > 0
    assert np.exp(-40.0 / 2.0) < IDENTIFY.online_floor  # without the floor nothing would be left


@pytest.mark.parametrize("memory", [0.0, -1.0, float("nan")])
def test_a_memory_that_is_none_is_refused(rig: Rig, memory: float) -> None:
    with pytest.raises(InputError, match="expected more than 0"):
        Tracker(rig, memory=memory)


def test_repeats_take_over_from_pieces_of_the_only_record(multisine_run: Run, rig: Rig) -> None:
    tracker = Tracker(rig)
    first, second = (r for r in multisine_run.records[:2])
    tracker.begin(head_of(first))
    assert np.isnan(tracker.estimates()["b"].value)
    tracker.discard()
    track(tracker, first)
    assert tracker.estimates()["b"].std > 0
    track(tracker, second)
    built = build_rows(rig, [Run(rig, (first, second))], TERMS)
    batch = solve_reductions(rig, TERMS, reduce_rows(rig, TERMS, built))
    scale = tracker.estimates()["C_pp_2"].std ** 2
    k = batch["fluid"].names.index("C_pp_2")
    assert scale == pytest.approx(batch["fluid"].covariance[k, k], rel=1e-6)


def test_the_residual_of_new_rows_is_that_of_the_estimates_before_them() -> None:
    """Against numpy's least squares of the rows before; unknown columns have no residual."""
    rng = np.random.default_rng(5)
    first, second = rng.normal(size=(2, 60, 2))
    y1, y2 = rng.normal(size=(2, 60))
    head = RecordHead("step1_r1", "step1", (), 1, 1000.0, 60, ())
    time = np.arange(60) / 10.0

    def rows(matrix: np.ndarray, rhs: np.ndarray) -> Rows:
        return Rows("flow_cap_1", ("a", "c"), matrix, rhs, time, 0)

    kept = _Filter(("a", "c"), np.inf)
    one_column = first * [1.0, 0.0]
    kept.fold(head, [rows(one_column, y1)], 0.0)
    assert kept.residual is None, "nothing was known before"
    kept.fold(head, [rows(second, y2)], 6.0)
    assert kept.residual is None, "its second column was not known"
    before = np.linalg.lstsq(np.vstack((one_column, second)), np.append(y1, y2))[0]
    kept.fold(head, [rows(first, y1)], 12.0)
    assert kept.residual is not None
    assert kept.residual.rms == pytest.approx(np.sqrt(np.mean((y1 - first @ before) ** 2)))
    assert kept.residual.size == pytest.approx(np.sqrt(np.mean(y1**2)))
