"""The contact of a seal along a path, against a solver of its differential equation in time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.special import erf
from scipy.stats import cauchy, norm

from analysis.effects.contact import (
    CAUCHY,
    GRID_RATIO,
    TRANSITION,
    contact_range,
    contact_state,
    contact_under_load,
    memoryless,
    stiffened_path,
)
from analysis.effects.friction import CoulombFriction, StribeckFriction
from analysis.effects.friction_levels import AsymmetricFriction, PressureDependentFriction
from analysis.signals.conditioning import condition
from analysis.terms.base import Used
from rig.model.records import Run
from rig.model.rig import Rig

AMPLITUDE, FREQUENCY = 5e-4, 2.0
DISTANCE = 60e-6


def place(t: np.ndarray | float) -> np.ndarray:
    return np.asarray(AMPLITUDE * np.sin(2 * np.pi * FREQUENCY * np.asarray(t)))


def speed(t: np.ndarray | float) -> np.ndarray:
    omega = 2 * np.pi * FREQUENCY
    return np.asarray(AMPLITUDE * omega * np.cos(omega * np.asarray(t)))


@pytest.mark.parametrize("stiffening", [0.0, 250.0])
def test_a_contact_along_the_worked_path_is_that_of_its_equation_in_time(stiffening: float) -> None:
    t = np.arange(4000) / 4000

    def rate(now: float, z: np.ndarray) -> np.ndarray:
        v = float(speed(now))
        return (1 + stiffening * abs(v)) * (v - abs(v) * z) / DISTANCE

    wanted = solve_ivp(rate, (0.0, t[-1]), [0.0], t_eval=t, rtol=1e-9, atol=1e-9, max_step=1e-3)
    found = contact_state(stiffened_path(place(t), speed(t), stiffening), DISTANCE)
    assert found == pytest.approx(wanted.y[0], abs=3e-3)


def test_a_contact_that_stiffens_turns_over_sooner_the_faster_it_is_reversed() -> None:
    """Half of the force is back after 0.69 d of travel at rest, after less of it at speed."""
    needed = []
    for pace in (1.0, 4.0):
        t = np.arange(20_000) / 20_000 / pace
        s, v = place(pace * t), pace * speed(pace * t)
        z = contact_state(stiffened_path(s, v, 250.0), DISTANCE)
        turn = int(np.argmax(s))
        there = turn + int(np.argmax(z[turn:] < 0.0))
        needed.append(s[turn] - s[there])
    assert needed[1] < 0.8 * needed[0] < 0.8 * np.log(2) * DISTANCE


def test_a_level_that_does_not_change_is_the_plain_contact() -> None:
    s = place(np.arange(2000) / 2000)
    force = contact_under_load(s, np.full(len(s), 3.0), 3.0 / DISTANCE)
    assert force == pytest.approx(3.0 * contact_state(s, DISTANCE))


def test_without_memory_a_contact_is_the_mean_sign_of_a_velocity_that_is_spread() -> None:
    """P(v > 0) - P(v < 0) of a normal spread, and of Cauchy's, whose tails are heavier."""
    v, w = np.linspace(-0.2, 0.2, 41), 4e-3
    spread = norm(v, w / np.sqrt(2))
    assert memoryless(v, w) == pytest.approx(spread.sf(0.0) - spread.cdf(0.0))
    heavier = cauchy(v, w)
    assert memoryless(v, w, CAUCHY) == pytest.approx(heavier.sf(0.0) - heavier.cdf(0.0))


def test_a_transition_speed_that_is_not_given_is_the_narrowest() -> None:
    """An exponent of the fall stands behind it in the shape."""
    effect = StribeckFriction("joint 2")
    for shape in ((0.03, 0.0), (0.03, 0.0, 0.0, 1.0)):
        assert effect.contact_of(shape) == (0.0, 0.0, TRANSITION)


def test_a_level_without_memory_has_either_tail_and_returns_to_the_other(rig: Rig) -> None:
    for effect in (CoulombFriction("joint 1"), AsymmetricFriction("joint 1")):
        normal = (0.0, 0.0, 2e-3)
        (heavy,) = effect.other_form_starts(rig, normal)
        assert heavy == (*normal, CAUCHY)
        assert effect.shape_names()[-1] == "tail_1"
        assert effect.other_form_starts(rig, heavy) == (normal,)
    assert "tail_1" not in StribeckFriction("joint 1").shape_names()


def test_noise_at_rest_is_no_force_of_levels_that_differ(rig: Rig, multisine_run: Run) -> None:
    """The mean of a noisy |z| is not 0 at rest; in motion the levels stay as they are."""
    moving = condition(rig, multisine_run.records[0])
    noise = 2e-3 * np.random.default_rng(1).standard_normal(moving.sd.shape)
    resting = replace(moving, sd=noise, path_cutoffs=None)
    effect, shape = AsymmetricFriction("joint 1"), (0.0, 0.0, 4e-3)
    z = effect.contact(rig, resting, shape)
    assert np.mean(effect.size(resting, z, shape)) < 0.3 * np.mean(np.abs(z))
    extending, retracting = effect.columns(rig, moving, shape)["torque_1"].values()
    z = effect.contact(rig, moving, shape) * moving.G[:, 0]
    fast = np.abs(moving.sd[:, 0]) > 4e-3
    assert extending[fast] == pytest.approx(np.maximum(z, 0.0)[fast])
    assert retracting[fast] == pytest.approx(np.minimum(z, 0.0)[fast])


def test_a_shape_without_the_detail_is_a_contact_that_does_not_stiffen(
    rig: Rig, multisine_run: Run
) -> None:
    signals = condition(rig, multisine_run.records[0])
    for kind, equation in ((CoulombFriction, "torque_1"), (PressureDependentFriction, "torque_1")):
        effect = kind("joint 1")
        old, new = (effect.columns(rig, signals, s)[equation] for s in ((4e-5,), (4e-5, 0.0)))
        assert {n: c.tolist() for n, c in old.items()} == {n: c.tolist() for n, c in new.items()}
        values = dict.fromkeys(old, 50.0)
        packed = [effect.pack(rig, values, s).tolist() for s in ((4e-5,), (4e-5, 0.0))]
        assert packed[0] == packed[1]
    assert "stiffening_1" not in StribeckFriction("joint 1").shape_names()


@pytest.mark.parametrize(
    ("coulomb", "breakaway", "falls"),
    [
        # Force [N] and transition speed [m/s]; then force, Stribeck and transition speed.
        ((300.0, 1e-3), (400.0, 0.01, 1e-3), True),
        ((0.0, 1e-3), (400.0, 0.01, 1e-3), True),
        # Rises over a wide transition while the breakaway falls: the sum only rises.
        ((1000.0, 0.02), (450.0, 0.016, 4e-3), False),
        # Falls beyond the speeds of the records.
        ((300.0, 1e-3), (400.0, 0.3, 1e-3), False),
    ],
)
def test_a_breakaway_is_seen_where_friction_falls_within_the_speeds_of_the_records(
    rig: Rig, multisine_run: Run,
    coulomb: tuple[float, float], breakaway: tuple[float, float, float], falls: bool,
) -> None:  # fmt: skip
    conditioned = (condition(rig, record) for record in multisine_run.records)
    signals = [s for s in conditioned if s.excited[1]][:1]
    Fc, Fs = CoulombFriction("joint 2"), StribeckFriction("joint 2")
    force, falling, width = breakaway
    shape = (falling, 0.0, width)
    terms = [Used(Fc, (0.0, 0.0, coulomb[1])), Used(Fs, shape)]
    said = Fs.not_shown(rig, {"Fc2": coulomb[0], "Fs2": force}, shape, terms, signals)
    assert (said == "") == falls
    # The curve itself, by hand.
    top = float(np.abs(signals[0].sd[:, 1]).max())
    v = np.linspace(1e-4, top, 3000)
    curve = coulomb[0] * erf(v / coulomb[1]) + force * np.exp(-((v / falling) ** 2)) * erf(
        v / width
    )
    assert (curve.max() - curve[-1] > force / 3) == falls


def test_a_fall_over_most_of_the_speeds_is_no_breakaway(rig: Rig, multisine_run: Run) -> None:
    """A level and a share of the viscous friction make the same curve within 7 % of the force."""
    conditioned = (condition(rig, record) for record in multisine_run.records)
    signals = [s for s in conditioned if s.excited[1]][:1]
    top = float(np.abs(signals[0].sd[:, 1]).max())
    v = np.linspace(1e-4, top, 500)
    lines = np.column_stack([np.ones_like(v), v])
    effect = StribeckFriction("joint 2")
    for share, shown in ((0.2, True), (0.55, False), (0.8, False)):
        shape = (share * top, 0.0, 1e-4)
        said = effect.not_shown(rig, {"Fs2": 400.0}, shape, [Used(effect, shape)], signals)
        assert ("viscous friction fits such a fall" in said) != shown
        curve = np.exp(-((v / shape[0]) ** 2))
        left = curve - lines @ np.linalg.lstsq(lines, curve)[0]
        assert (np.std(left) > 0.07) == shown


def test_a_presliding_distance_grows_with_bore_and_stroke(rig: Rig) -> None:
    """The mounting of a long cylinder yields too; a search from far below ends elsewhere."""
    joint = rig.joints[0]
    long = joint.cylinder.model_copy(update={"stroke": 1.5, "cap_area": 0.02, "rod_area": 0.012})
    big = rig.model_copy(update={"joints": (joint.model_copy(update={"cylinder": long}),)})
    among = contact_range(big, 0)
    assert among.distance_bounds[1] == pytest.approx(7.5e-3)
    assert max(among.distances) > among.distance_bounds[1] / GRID_RATIO
    small = contact_range(rig, 0)
    assert small.distance_bounds[1] < 1e-3
