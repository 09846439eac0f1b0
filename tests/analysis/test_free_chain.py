"""Freely swinging chains: against an independent library, and against a measured machine."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rig.model.parameters import mechanical_names
from rig.model.rig import Rig
from tests.analysis.test_mechanics_oracle import Chain, pin
from tests.analysis.test_terms import chain_rig
from tests.studies.machines.bodies import chain_parameters
from tests.studies.machines.free_chain import (
    Scale,
    Swing,
    identify_free,
    refine_free,
    simulate_free,
    window_error,
    windows,
)
from tests.studies.machines.pendulum import (
    WINDOWS,
    Compared,
    compared_json,
    compared_text,
    read_pendulum,
)

Array = np.ndarray


def swung(chain: Chain, theta: Array, friction: Array, samples: int) -> Array:
    """Absolute angles of a chain let go at rest, by pinocchio in relative ones, 0.5 ms steps."""
    N = len(theta)
    q, qd, h = np.diff(theta, prepend=0.0), np.zeros(N), 0.5e-3

    def rates(q: Array, qd: Array) -> Array:
        return np.asarray(pin.aba(chain.model, chain.data, q, qd, -friction * qd))

    out = np.empty((samples, N))
    for n in range(2 * samples):
        if n % 2 == 0:
            out[n // 2] = np.cumsum(q)
        a, b = qd, rates(q, qd)
        c, d = qd + 0.5 * h * b, rates(q + 0.5 * h * a, qd + 0.5 * h * b)
        e, f = qd + 0.5 * h * d, rates(q + 0.5 * h * c, qd + 0.5 * h * d)
        g, k = qd + h * f, rates(q + h * e, qd + h * f)
        q = q + h / 6 * (a + 2 * (c + e) + g)
        qd = qd + h / 6 * (b + 2 * (d + f) + k)
    return out


def let_go(joints: int, rig: Rig, samples: int = 1500) -> tuple[Rig, dict[str, float], list[Swing]]:
    chain = Chain(joints, np.random.default_rng(joints))
    friction = np.linspace(0.05, 0.02, joints)
    values = chain_parameters(chain.bodies) | {
        f"Fv{i + 1}": float(f) for i, f in enumerate(friction)
    }
    rng = np.random.default_rng(5)
    starts = rng.uniform(-1.2, 1.2, (3, joints))
    swings = [Swing(1000.0, swung(chain, start, friction, samples)) for start in starts]
    return chain_rig(rig, joints), values, swings


@pytest.mark.parametrize("joints", [1, 2, 3])
def test_the_chain_swings_as_the_oracles(joints: int, rig: Rig) -> None:
    described, values, swings = let_go(joints, rig, 600)
    start = np.concatenate((swings[0].theta[0], np.zeros(joints)))
    found = simulate_free(described, values, start[None], 600)[:, 0]
    np.testing.assert_allclose(found, swings[0].theta, atol=2e-6)


@pytest.mark.parametrize("joints", [2, 3])
def test_parameters_are_found_up_to_one_scale(joints: int, rig: Rig) -> None:
    described, values, swings = let_go(joints, rig)
    doubled = Scale("W1", 2.0 * values["W1"])
    found = identify_free(described, swings, doubled)
    for name, value in values.items():
        allowed = 0.05 if name.startswith("Fv") else 2e-3
        assert found[name] == pytest.approx(2.0 * value, rel=allowed), name


@pytest.mark.slow
def test_output_error_takes_out_what_noise_did_to_the_rows(rig: Rig) -> None:
    described, values, swings = let_go(2, rig)
    rng = np.random.default_rng(9)
    noisy = [Swing(s.rate, s.theta + 2e-4 * rng.standard_normal(s.theta.shape)) for s in swings]
    scale = Scale("W1", values["W1"])
    rows = identify_free(described, noisy, scale)
    cut = windows(noisy, 0.6)
    refined, started = refine_free(described, rows, cut, scale)
    assert window_error(described, refined, started) == pytest.approx(2e-4, rel=0.05)

    def off(found: dict[str, float]) -> float:
        return max(abs(found[name] / values[name] - 1) for name in ("M1", "M2", "R12", "W2"))

    assert off(refined) < 5e-3
    assert off(refined) < off(rows)


def measured() -> Path:
    given = os.environ.get("BRAMAH_DATA")
    root = Path(given) if given else Path(__file__).parents[3] / "shared" / "data"
    folder = root / "multiarm_pendulum"
    if not folder.is_dir():
        pytest.skip(f"no measured double pendulum in {folder}; set BRAMAH_DATA")
    return folder


def test_the_measured_double_pendulum_is_simulated_at_its_authors_error_or_better() -> None:
    """Their parameters against ours by rows alone, on segments that served neither fit."""
    what = read_pendulum(measured())
    ours = identify_free(what.rig, what.fitted, Scale("W1", what.authors["W1"]))
    for name in ("M1", "M2", "R12", "W2"):
        assert ours[name] == pytest.approx(what.authors[name], rel=0.01), name
    cut = windows(what.judged, 0.5)
    error = window_error(what.rig, ours, cut)
    assert error <= window_error(what.rig, what.authors, cut)
    assert error < 2e-3


def test_what_is_reported_is_held_against_the_authors_window_by_window() -> None:
    values = dict.fromkeys(mechanical_names(2), 1.0)
    errors = {"authors": 2.0e-3, "fitted": 1.9e-3, "rows alone": 2.1e-3}
    cells = ("Y_vad", "Y_id")
    found = Compared(
        dict.fromkeys(errors, values),
        {way: {c: {s: e * s for s in WINDOWS} for c in cells} for way, e in errors.items()},
    )
    assert found.over_authors() == pytest.approx(0.95)
    assert "at the authors' error or better in every window" in compared_text(found)
    worse = replace(found, errors={**found.errors, "fitted": found.errors["rows alone"]})
    assert "worse than the authors" in compared_text(worse)
    assert compared_json(found)["reported"] == "fitted"
