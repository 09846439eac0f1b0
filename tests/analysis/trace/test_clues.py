"""A person asks what an unexplained residual moves with: one variable, a product, or a memory."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from analysis.signals.conditioning import Signals
from analysis.terms import baseline_of
from analysis.terms.base import Used
from analysis.trace.clues.dependence import dependences
from analysis.trace.clues.equation_rows import EquationSides, equation_rows, factor_of
from analysis.trace.data.conditioned_record import conditioned_records, filtered, prepared_signals
from analysis.trace.data.regression_data import RegressionData, regression_data
from analysis.trace.result import Dependence
from analysis.trace.search.hypothesis import energy_above_noise
from rig.model.rig import Rig
from tests.analysis.trace.hidden import pair_of_runs

Array = NDArray[np.float64]
Force = Callable[[Signals], Array]


@pytest.fixture(scope="module")
def boards(rig: Rig) -> tuple[RegressionData, RegressionData]:
    train, held_out = pair_of_runs(rig)
    terms = tuple(map(Used, baseline_of(rig)))
    train_data = regression_data(rig, terms, conditioned_records(rig, [train]))
    return train_data, regression_data(
        rig, terms, conditioned_records(rig, [held_out]), train_data.beta
    )


def residual(
    train_data: RegressionData, equation: str, force: Force, rng: np.random.Generator
) -> Array:
    """Return a whitened residual of noise, and of `force` [SI] in one equation."""
    out = rng.normal(size=train_data.base.shape[0])
    index = {conditioned.group: k for k, conditioned in enumerate(train_data.records)}
    for s in train_data.segments:
        if s.equation == equation:
            k = index[s.group]
            conditioned, rows = train_data.records[k], train_data.rows[k][equation]
            raw = force(prepared_signals(train_data.rig, train_data.terms, conditioned))
            found = filtered({"x": raw}, conditioned, rows)["x"]
            out[s.where] += np.sqrt(s.repeats) / s.noise * found
    return out


def clues(
    boards: tuple[RegressionData, RegressionData], equation: str, force: Force
) -> list[Dependence]:
    rng = np.random.default_rng(3)
    one, other = (residual(b, equation, force, rng) for b in boards)
    first, second = (
        equation_rows(b, r, equation) for b, r in zip(boards, (one, other), strict=True)
    )
    assert first is not None
    assert second is not None
    sides = EquationSides(boards[0].rig, equation, first, second)
    return dependences([sides], {equation: max(0.0, energy_above_noise(boards[0], one)[equation])})


def test_a_spring_that_hardens_moves_with_the_piston_alone(
    boards: tuple[RegressionData, RegressionData],
) -> None:
    best, *_ = clues(boards, "torque_2", lambda x: 4e5 * x.s[:, 1] ** 3)
    assert (best.variable, best.by) == ("piston_2", "")
    assert best.share > 0.5


def test_friction_that_grows_along_the_bore_is_a_product(
    boards: tuple[RegressionData, RegressionData],
) -> None:
    best, *_ = clues(
        boards, "torque_2", lambda x: 5.0 * (1 + 60 * x.s[:, 1]) * np.tanh(x.sd[:, 1] / 2e-3)
    )
    assert (best.variable, best.by) == ("piston_2", "velocity_2")
    assert best.text == "piston_2 times the direction of velocity_2"
    assert best.share > 0.8


def test_a_contact_that_gives_before_it_slides_has_a_memory(
    boards: tuple[RegressionData, RegressionData],
) -> None:
    def force(x: Signals) -> Array:  # of Coulomb springs in parallel (Iwan 1966), no Dahl state
        s = x.s[:, 1]
        out = np.zeros(len(s))
        for give in (1e-3, 2e-3, 3e-3):
            held = 0.0
            for k in range(1, len(s)):
                held = float(np.clip(held + s[k] - s[k - 1], -give, give))
                out[k] += 4.0 * held / give
        return out

    found = clues(boards, "torque_2", force)
    assert found[0].variable == "velocity_2"
    assert "memory" in found[0].text
    # Pressures balance whatever acts: they follow the residual as well and tell nothing.
    assert any(d.variable.startswith(("pressure", "rod", "cap")) for d in found[1:])


def test_a_leak_past_a_worn_place_is_a_product_in_the_flow(
    boards: tuple[RegressionData, RegressionData],
) -> None:
    found = clues(
        boards, "flow_cap_2",
        lambda x: 3e-12 * (x.p_cap[:, 1] - x.p_rod[:, 1]) * np.exp(-((x.s[:, 1] / 8e-3) ** 2)),
    )  # fmt: skip
    assert (found[0].variable, found[0].by) == ("piston_2", "pressure_difference_2")


def test_noise_alone_gives_no_clue(boards: tuple[RegressionData, RegressionData]) -> None:
    assert clues(boards, "torque_2", lambda x: np.zeros(len(x.t))) == []


def test_the_memory_of_direction_is_dahls_exponential_in_the_way_gone() -> None:
    there, back = np.linspace(0.0, 0.05, 4001), np.linspace(0.05, 0.03, 1601)
    s = np.concatenate((there, back[1:]))[:, None]
    still = np.zeros_like(s)
    signals = Signals.__new__(Signals)
    object.__setattr__(signals, "s", s)
    object.__setattr__(signals, "sd", still)
    z = factor_of("memory", signals, 0, travel=0.05)  # gives over a tenth of it: 5 mm
    way = 0.05 - s[4001:, 0]
    assert z[4000] == pytest.approx(1.0, abs=1e-3)
    assert z[4001:] == pytest.approx(2.0 * np.exp(-way / 0.005) - 1.0, abs=5e-3)
