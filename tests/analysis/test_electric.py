"""An electric arm on a slope nobody has measured; friction that holds without chattering."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares
from scipy.signal import cont2discrete

from analysis.identify.estimators import nuisance
from analysis.identify.identify import identify
from analysis.identify.result import to_json
from analysis.identify.stacked_rows import build_rows
from analysis.signals.conditioning import condition
from analysis.signals.filters import butterworth, channel_filter
from analysis.simulation.model import Estimate, Model, load_model, save_model
from analysis.simulation.simulate import DrivingInput, State, compiled, simulate
from analysis.simulation.validate import validate
from analysis.terms import baseline_of, with_effects
from analysis.terms.base import Used
from rig.model.parse import InputError
from rig.model.records import Record, Run
from rig.model.rig import ElectricRig, Rig
from rig.runs.rigs import load_rig
from tests.analysis.right_hand_side import rates_of
from tests.studies.machines import electric_plant as plant

FRICTION = ("coulomb_friction",)


@pytest.fixture(scope="module")
def robot() -> ElectricRig:
    found = load_rig("electric-2dof")
    assert isinstance(found, ElectricRig)
    return found


@pytest.fixture(scope="module")
def arm() -> plant.Arm:
    return plant.draw_arm(np.random.default_rng(5))


@pytest.fixture(scope="module")
def run(robot: ElectricRig, arm: plant.Arm) -> Run:
    return plant.records(robot, arm, np.random.default_rng(6), repeats=2)


def used(robot: Rig, *effects: str) -> list[Used]:
    return [Used(term) for term in with_effects(robot, effects)]


def model_of(robot: Rig, effects: tuple[str, ...], **values: float) -> Model:
    none = (float("nan"), float("nan"))
    estimates = {n: Estimate(v, "", float("nan"), none) for n, v in values.items()}
    k = len(values)
    return Model(robot, tuple(used(robot, *effects)), estimates, np.full((k, k), np.nan))


def drive_of(robot: Rig, u: np.ndarray) -> DrivingInput:
    n, joints = u.shape
    flat, still = np.zeros(n), np.zeros((n, joints))
    free = np.zeros(joints, dtype=bool)
    return DrivingInput(robot.sample_rate, u, flat, flat, free, still, still, still)


def at_rest(joints: int) -> State:
    zero = np.zeros(joints)
    return State(zero, zero, zero, zero)


# The two-link mechanics against Newton and Euler's recursion


def test_the_chain_with_a_slope_is_the_recursion_over_rigid_links(
    robot: ElectricRig, arm: plant.Arm
) -> None:
    truth = arm.truth()
    effects = model_of(robot, (), **{n: v for n, v in truth.items() if not n.startswith("Fc")})
    rng = np.random.default_rng(0)
    machine = np.array([*arm.mass, *arm.centre, *arm.inertia, arm.length, arm.slope])
    for _ in range(20):
        q, qd, qdd = rng.normal(size=(3, 2))
        torque = plant._torques(q, qd, qdd, robot.gravity, machine) + np.array(arm.viscous) * qd
        current = torque / [joint.drive.gain for joint in robot.joints]
        dynamics = rates_of(compiled(effects), drive_of(robot, np.tile(current, (3, 1))))
        dy = dynamics(0.0, np.concatenate((q, qd, np.zeros(4))))
        np.testing.assert_allclose(dy[:4], np.concatenate((qd, qdd)), rtol=1e-9)


def test_a_known_inclination_turns_gravity(robot: ElectricRig, arm: plant.Arm) -> None:
    truth = {n: v for n, v in arm.truth().items() if not n.startswith("Fc")}
    turned = robot.model_copy(update={"inclination": truth["base_inclination"]})
    current = drive_of(robot, np.full((200, 2), 0.5))
    unknown = simulate(model_of(robot, (), **truth), current, at_rest(2))
    del truth["base_inclination"]
    known = simulate(model_of(turned, (), **truth), current, at_rest(2))
    np.testing.assert_allclose(known.q, unknown.q, atol=1e-9)


# Identification on the slope


def test_mechanics_and_slope_are_identified_together(
    robot: ElectricRig, arm: plant.Arm, run: Run
) -> None:
    result = identify([run], terms=used(robot, *FRICTION))
    truth = arm.truth()
    for name, estimate in result.estimates.items():
        band = 0.1 if name.startswith("Fc") else 0.04 if name.startswith("Fv") else 0.012
        assert estimate.value == pytest.approx(truth[name], rel=band), name
    assert result.estimates["base_inclination"].unit == "rad"
    assert result.rows["mechanical"] > 1000
    assert "fluid" not in to_json(result)["rows"]
    test = plant.records(robot, arm, np.random.default_rng(7), repeats=1)
    (judged,) = validate(result.model, [test])
    assert min(judged.fit.values()) > 97.0
    assert judged.units == {"position_1": "rad", "position_2": "rad"}


@pytest.mark.parametrize("method", ["sequential", "pso", "ga"])
def test_methods_for_pressures_and_flows_are_refused(run: Run, method: str) -> None:
    with pytest.raises(InputError, match=rf"method {method} needs pressures and flows.*electric"):
        identify([run], method=method)


@pytest.mark.slow
def test_noise_that_the_rig_file_does_not_state_biases_least_squares_and_is_seen(
    robot: ElectricRig, arm: plant.Arm
) -> None:
    """The encoders are 30 times noisier than stated; the base's slope is known."""
    known = robot.model_copy(update={"inclination": arm.slope})
    encoder = known.sensors.position
    noisy = encoder.model_copy(update={"noise": 30 * encoder.noise})
    machine = known.model_copy(
        update={"sensors": known.sensors.model_copy(update={"position": noisy})}
    )
    measured = plant.records(machine, arm, np.random.default_rng(6), repeats=4)
    run, truth = Run(known, measured.records), arm.truth()
    plain = identify([run], terms=used(known, *FRICTION), estimator="ls")
    found = identify([run], terms=used(known, *FRICTION))
    assert plain.estimates["M1"].value == pytest.approx(truth["M1"], rel=0.15)
    assert plain.estimates["M1"].value < 0.95 * truth["M1"]
    assert found.model.provenance["estimator"] == "iv"
    for name in ("M1", "R12", "W1", "W2"):
        assert found.estimates[name].value == pytest.approx(truth[name], rel=0.006), name
    for name in ("M1", "W1", "W2"):
        low, high = plain.estimates[name].ci95
        assert low < truth[name] < high, name


def test_taking_the_base_for_level_spoils_the_mechanics(
    robot: ElectricRig, arm: plant.Arm, run: Run
) -> None:
    level = robot.model_copy(update={"inclination": 0.0})
    wrong = identify([Run(level, run.records)], terms=used(level, *FRICTION))
    truth = arm.truth()
    assert abs(wrong.estimates["W2"].value / truth["W2"] - 1) > 0.1
    assert abs(wrong.estimates["M2"].value / truth["M2"] - 1) > 0.05


def test_the_reduction_is_nonlinear_least_squares_of_the_rows(robot: ElectricRig, run: Run) -> None:
    result = identify([run], terms=used(robot), estimator="plain")
    rows = [r for one in build_rows(robot, [run], used(robot)) for r in one.rows.values()]
    X, y = np.concatenate([r.matrix for r in rows]), np.concatenate([r.rhs for r in rows])
    names = rows[0].names
    assert names[-4:] == ("W1 cos", "W2 cos", "W1 sin", "W2 sin")

    def residual(p: np.ndarray) -> np.ndarray:
        W, a = p[5:7], p[7]
        return np.asarray(X @ np.concatenate((p[:5], W * np.cos(a), W * np.sin(a))) - y)

    found = least_squares(residual, np.append(np.ones(7), 0.1), xtol=1e-14, ftol=1e-14)
    values = [e.value for e in result.estimates.values()]
    np.testing.assert_allclose(values, found.x, rtol=1e-6)


SLOPED = {
    "M1": 1.6, "M2": 0.3, "R12": 0.3, "Fv1": 1.5, "Fv2": 0.5, "W1": 2.6, "W2": 0.5,
    "base_inclination": -0.2,
}  # fmt: skip


def noisy_runs(
    robot: ElectricRig, count: int, encoder_noise: float, rng: np.random.Generator
) -> Iterator[Run]:
    """Yield runs of four repeats of the model's own motion, each with fresh noise."""
    t = np.arange(4000) / 1000.0
    u = np.column_stack([2.0 * np.sin(2 * np.pi * 0.5 * t), np.sin(2 * np.pi * 0.75 * t + 1)])
    clean = simulate(model_of(robot, (), **SLOPED), drive_of(robot, u), at_rest(2))
    for _ in range(count):
        records = []
        for repeat in (1, 2, 3, 4):
            position = clean.q + encoder_noise * rng.standard_normal((4000, 2))
            drive = u + 5e-3 * rng.standard_normal((4000, 2))
            channels = {f"position_{i + 1}": position[:, i] for i in range(2)}
            channels |= {f"drive_{i + 1}": drive[:, i] for i in range(2)}
            records.append(Record(f"both_r{repeat}", "both", (), repeat, 1000.0, channels))
        yield Run(robot, tuple(records))


def test_noise_of_the_encoders_is_in_the_intervals_with_an_unknown_slope_too(
    robot: ElectricRig,
) -> None:
    """It biases least squares, which the repeats alone do not show."""
    encoder = robot.sensors.position.model_copy(update={"noise": 2e-5})
    sensors = robot.sensors.model_copy(update={"position": encoder})
    noisy = robot.model_copy(update={"sensors": sensors})
    (run,) = noisy_runs(noisy, 1, 2e-5, np.random.default_rng(7))
    outside = {}
    for estimator in ("plain", "auto", "ls", "iv"):
        found = identify([run], estimator=estimator).estimates
        outside[estimator] = [
            name for name, value in SLOPED.items()
            if not found[name].ci95[0] < value < found[name].ci95[1]
        ]  # fmt: skip
    assert len(outside["plain"]) >= 3
    assert max(len(outside[e]) for e in ("auto", "ls", "iv")) <= 1


def test_the_interval_of_the_slope_covers_it_on_data_of_the_model_itself(
    robot: ElectricRig,
) -> None:
    """Fresh noise on exact motion: twelve experiments, the interval holds the slope in most."""
    rng = np.random.default_rng(11)
    inside = 0
    for run in noisy_runs(robot, 12, 1e-6, rng):
        found = identify([run]).estimates["base_inclination"]
        inside += found.ci95[0] <= -0.2 <= found.ci95[1]
        assert found.value == pytest.approx(-0.2, abs=2e-3)
    assert inside >= 9


def test_a_joint_held_by_its_position_loop_is_a_locked_joint(
    robot: ElectricRig, arm: plant.Arm
) -> None:
    rng = np.random.default_rng(8)
    one = plant.records(robot, arm, rng, step="one", repeats=2)
    two = plant.records(robot, arm, rng, step="two", repeats=2)
    together = identify([one, two], terms=used(robot, *FRICTION))
    truth = arm.truth()
    for name in ("W1", "W2", "base_inclination"):
        assert together.estimates[name].value == pytest.approx(truth[name], rel=0.02)
    alone = identify([one], terms=used(robot))
    lost = next(c for c in alone.checks if c.name == "excited joints")
    assert not lost.ok
    assert "joint 2" in lost.detail


def test_a_model_with_a_slope_survives_its_file(robot: ElectricRig, run: Run, tmp_path) -> None:
    model = identify([run], terms=used(robot, *FRICTION)).model
    save_model(model, tmp_path / "m.json")
    again = load_model(tmp_path / "m.json")
    assert again.rig == robot
    assert again.terms == model.terms
    assert again.values == pytest.approx(model.values)


@pytest.mark.parametrize(
    ("effect", "said"),
    [
        ("stiction", "unknown term 'stiction'"),
        ("coulomb_friction@joint 3", "no place 'joint 3' .* one of 'coulomb_friction@joint 1'"),
        ("coulomb_friction@elbow", "no place 'elbow' .* one of 'coulomb_friction@joint 1'"),
        ("internal_leakage", "does not act on rig"),
    ],
)
def test_an_effect_that_cannot_be_is_refused(robot: ElectricRig, effect: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        with_effects(robot, [effect])


@pytest.mark.parametrize("effect", ["channel_delay@joint 1", "sensor_gain@joint 2 bogus"])
def test_an_effect_of_a_sensor_needs_its_channel(effect: str) -> None:
    with pytest.raises(InputError, match=r"no place .* one of .*@joint 1 piston'"):
        with_effects(load_rig("shinshu-2dof"), [effect])


def test_an_effect_of_one_chamber_needs_its_chamber() -> None:
    with pytest.raises(InputError, match=r"needs its place .* one of 'dead_volume@joint 1 cap'"):
        with_effects(load_rig("shinshu-2dof"), ["dead_volume"])


def test_an_effect_given_twice_is_refused(robot: ElectricRig) -> None:
    with pytest.raises(InputError, match="in the model already"):
        with_effects(robot, ["torque_offset", "torque_offset@joint 2"])


def test_inclination_takes_the_place_of_gravity() -> None:
    names = [t.name for t in with_effects(load_rig("shinshu-2dof"), ["base_inclination"])]
    assert "gravity" not in names
    assert names[-1] == "inclined_gravity"


# Dry friction in simulation

SLIDE = {"M1": 95.0, "Fv1": 200.0, "Fc1": 20.0, "offset1": -3.0}
BOTH = ("coulomb_friction", "torque_offset")


def test_a_sticking_joint_stays_and_does_not_chatter() -> None:
    emps = load_rig("emps")
    drive = np.full((10_000, 1), (15.0 - 3.0) / 35.15065)  # 15 N beyond the offset, of 20 N
    result = simulate(model_of(emps, BOTH, **SLIDE), drive_of(emps, drive), at_rest(1))
    assert not result.failure
    assert np.abs(result.q).max() < 1.5e-3  # creep below the transition speed for 10 s
    assert np.ptp(result.qd[2000:]) < 1e-6
    assert result.evaluations < 400_000


def test_sliding_and_sticking_follow_an_independent_integrator() -> None:
    emps = load_rig("emps")
    t = np.arange(2000) / 1000.0
    u = 1.2 * np.sin(2 * np.pi * 1.5 * t)[:, None]
    result = simulate(model_of(emps, BOTH, **SLIDE), drive_of(emps, u), at_rest(1))

    def rates(at: float, y: np.ndarray) -> list[float]:
        force = 35.15065 * np.interp(at, t, u[:, 0])
        dry = SLIDE["Fc1"] * math.erf(y[1] / 1e-4)
        return [y[1], (force - SLIDE["Fv1"] * y[1] - dry - SLIDE["offset1"]) / SLIDE["M1"]]

    other = solve_ivp(rates, (0, t[-1]), [0, 0], "Radau", t, rtol=1e-8, atol=1e-10, max_step=2e-3)
    np.testing.assert_allclose(result.q[:, 0], other.y[0], atol=2e-6)


def test_dry_friction_of_a_hydraulic_joint_is_a_force_at_the_piston(multisine_run: Run) -> None:
    bench = multisine_run.rig
    term = with_effects(bench, ["coulomb_friction@joint 2"])[-1]
    (coefficient,) = term.coefficients(bench)
    assert (coefficient.parameter, coefficient.unit) == ("Fc2", "N")
    record = next(r for r in multisine_run.records if 2 not in r.locked)
    signals = condition(bench, record)
    column = term.columns(bench, signals, ())["torque_2"]["Fc2"]
    fast = np.abs(signals.sd[:, 1]) > 1e-3
    expected = signals.G[:, 1] * np.sign(signals.sd[:, 1])
    np.testing.assert_allclose(column[fast], expected[fast], rtol=1e-6)


def test_filters_pass_electric_channels_like_any_other(robot: ElectricRig, run: Run) -> None:
    record = run.records[0]
    a = condition(robot, record, channel_filter(1000.0))
    b = condition(robot, record, butterworth(1000.0, 80.0))
    inner = slice(500, -500)
    np.testing.assert_allclose(a.qd[inner], b.qd[inner], atol=0.05)
    np.testing.assert_allclose(a.theta, np.cumsum(a.q, axis=1))


def test_a_current_that_follows_held_commands_leaves_viscous_friction_as_it_is(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A carriage, its command held for 1 ms and its current a lag of 0.8 ms behind it.

    Between samples the current runs along exponentials, on average ahead of the line between them
    by T^2 / (12 tau), 0.1 ms. Sampled exactly by another library.
    """
    rig = load_rig("emps")
    mass, viscous, lag, T = 95.0, 200.0, 8e-4, 1.0 / rig.sample_rate
    A = np.array([[0, 1, 0], [0, -viscous / mass, rig.drive_gains[0] / mass], [0, 0, -1 / lag]])
    step, drive, *_ = cont2discrete(
        (A, np.array([[0], [0], [1 / lag]]), np.eye(3), np.zeros((3, 1))), T
    )
    rng = np.random.default_rng(8)
    t = T * np.arange(8000)
    waves = rng.uniform(0, 2 * np.pi, 12)
    command = sum(0.5 * np.sin(2 * np.pi * (1.0 + k) * t + p) for k, p in enumerate(waves))
    state, states = np.array([0.12, 0.0, 0.0]), []
    for c in np.asarray(command):
        states.append(state)
        state = step @ state + drive[:, 0] * (c - 40.0 * (state[0] - 0.12))
    position, _, current = np.array(states).T

    def run_of(seed: int) -> Run:
        noise = np.random.default_rng(seed).standard_normal((2, len(t)))
        channels = {"position_1": position + 1e-7 * noise[0], "drive_1": current + 1e-4 * noise[1]}
        record = Record(f"held_r{seed}", "held", (), seed, rig.sample_rate, channels)
        return Run(rig, (record,), "held command")

    runs = [run_of(1), run_of(2)]
    terms = [Used(term) for term in baseline_of(rig)]
    found = identify(runs, terms=terms)
    low, high = found.model.parameters["Fv1"].ci95
    assert low < viscous < high
    half = 0.5 * (high - low)
    (check,) = (c for c in found.checks if c.name == "drive's path between samples at joint 1")
    assert check.detail.startswith("+0.10")
    monkeypatch.setattr(nuisance, "nuisance_terms", lambda *_: ())
    without = identify(runs, terms=terms).model.values["Fv1"]
    assert abs(without - viscous) > max(5 * half, 0.005 * viscous)
