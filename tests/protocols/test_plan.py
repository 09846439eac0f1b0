"""Everything a plan can get wrong is said before anything moves."""

from __future__ import annotations

import math

import numpy as np
import pytest

from protocols.files.library import load, read_protocol, shipped_names
from protocols.files.plan import (
    OIL_DAMPING,
    Overrides,
    largest_centring_gain,
    largest_position_gain,
    piston_gain,
    resolve,
)
from protocols.files.schema import Protocol
from rig.model.parse import InputError, parse_model
from rig.model.rig import Rig
from rig.runs.rigs import load_rig

TEXT = """\
name: mine
joints: 2
steps:
  - name: step1
    lock: [{joint: 1, at: closed, piston: 5 mm}]
    excite:
      - {joint: 2, signal: {kind: sine, frequency: 2 Hz, amplitude: 1 V}, centre: 3 mm}
    repeats: 2
    duration: 4 s
"""


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig("shinshu-2dof")


def plan_of(text: str, rig: Rig, **overrides: object):  # type: ignore[no-untyped-def]
    protocol = parse_model(Protocol, text, "mine.yaml")
    return resolve(protocol, rig, Overrides(**overrides))  # type: ignore[arg-type]


def test_a_plan_is_in_samples_and_counts_joints_from_zero(rig: Rig) -> None:
    plan = plan_of(TEXT, rig)
    (step,) = plan.steps
    assert (step.period, step.record, step.repeats) == (500, 4000, 2)
    assert (step.locks[0].joint, step.locks[0].piston) == (0, pytest.approx(5e-3))
    assert (step.excite[0].joint, step.excite[0].centre) == (1, pytest.approx(3e-3))
    assert plan.records == ("step1_r1", "step1_r2")
    assert plan.seconds > 2 * 4.0


def test_every_shipped_protocol_resolves_on_the_seed_bench(rig: Rig) -> None:
    for name in shipped_names():
        plan = resolve(load(name), rig)
        for step in plan.steps:
            assert step.record % step.period == 0
            assert step.warm_up % step.period == 0
            busy = {p.joint for p in (*step.locks, *step.excite)}
            assert busy == {0, 1}


def test_the_shipped_steps_are_those_of_the_paper(rig: Rig) -> None:
    for name in ("lock-and-excite", "lock-and-excite-multisine"):
        steps = resolve(load(name), rig).steps
        assert [s.name for s in steps] == ["step1", "step2", "step3"]
        locks = [(s.locks[0].joint, s.locks[0].at, s.excite[0].joint) for s in steps]
        assert locks == [(0, "closed", 1), (1, "end_min", 0), (1, "end_max", 0)]
    records = resolve(load("validate"), rig).records
    assert records == (
        "step1_1hz_r1", "step1_3hz_r1", "step2_1hz_r1", "step2_3hz_r1",
        "step3_1hz_r1", "step3_3hz_r1", "both_1hz_r1", "both_3hz_r1",
    )  # fmt: skip


def test_the_seed_sine_lasts_ten_times_ten_seconds(rig: Rig) -> None:
    for step in resolve(load("lock-and-excite"), rig).steps:
        assert (step.repeats, step.record, step.lines) == (10, 10_000, (1,))
        assert np.abs(step.excite[0].wave.samples).max() == pytest.approx(1.0)


def test_two_joints_share_a_period_and_their_lines(rig: Rig) -> None:
    text = TEXT.replace("    lock: [{joint: 1, at: closed, piston: 5 mm}]\n", "").replace(
        "    excite:\n",
        "    excite:\n      - {joint: 1, signal: {kind: sine, frequency: 3 Hz, amplitude: 1 V}}\n",
    )
    (step,) = plan_of(text, rig).steps
    assert (step.excite[0].wave.period, step.excite[1].wave.period) == (1000, 500)
    assert step.period == 1000
    assert step.lines == (2, 3)  # 2 Hz and 3 Hz in multiples of 1 Hz


def test_overrides_change_a_protocol_without_its_file(rig: Rig) -> None:
    name = "lock-and-excite-multisine"
    plain = resolve(load(name), rig)
    plan = resolve(
        load(name),
        rig,
        Overrides(repeats=2, amplitude_scale=0.5, seed=40, steps=("step1", "step3")),
    )
    assert plan.records == ("step1_r1", "step1_r2", "step3_r1", "step3_r2")
    rms = [np.sqrt(np.mean(s.excite[0].wave.samples ** 2)) for s in (*plan.steps, *plain.steps)]
    assert rms[0] == pytest.approx(0.5 * rms[2])
    assert rms[1] == pytest.approx(0.5 * rms[4])
    seeds = [s.excite[0].settings.signal.seed for s in plan.steps]  # type: ignore[union-attr]
    assert seeds == [40, 41]
    assert plan.seconds < plain.seconds


REFUSED = [
    ("amplitude: 1 V", "amplitude: 5 V", "step 'step1', joint 2: the command reaches 5 V.*4 V"),
    ("frequency: 2 Hz", "frequency: 125 Hz", "excites 125 Hz.*below 125 Hz"),
    ("frequency: 2 Hz", "frequency: 900 Hz", "joint 2: excites 900 Hz.*below 125 Hz"),
    ("frequency: 2 Hz", "frequency: 1e-7 Hz", r"joint 2: 1e-07 Hz has a period of 1e\+07 s.*600 s"),
    ("frequency: 2 Hz", "frequency: 2.00013 Hz", "joint 2: 2.00013 Hz never meets"),
    ("piston: 5 mm", "piston: 38 mm", r"joint 1 .* 38 mm, outside its stroke of \+-37.5 mm"),
    ("piston: 5 mm", "piston: 5 mm, tolerance: 1 um", "joint 1 .* 0.001 mm, .*at least 0.06 mm"),
    ("piston: 5 mm", "piston: 5 mm, tolerance: 2 m", "tolerance of 2000 mm .* at most 18.75 mm"),
    ("joints: 2\n", "joints: 2\nplace: {tolerance: 0.5 m}\n", "place.tolerance 500 mm .*'boom'"),
    ("centre: 3 mm", "centre: -37 mm", "centre -37 mm is outside limits.piston, -36 to 36 mm"),
    ("duration: 4 s", "duration: 4.2 s", "duration 4.2 s is 8.4 periods of 0.5 s"),
    ("duration: 4 s", "duration: 0.1 s", "expected a whole number"),
    ("duration: 4 s", "duration: 1e12 s", r"duration 1e\+12 s; expected at most 86400 s"),
    (
        "kind: sine, frequency: 2 Hz",
        "kind: ramp, rise: 1 s, hold: 1e9 s, rest: 0 s",
        "hold 1e.09 s",
    ),
    ("joints: 2\n", "joints: 2\nplace: {limit: 5 V}\n", "place.limit 5 V is above.*'boom'"),
    (
        "joints: 2\n",
        "joints: 2\nplace: {position_gain: 100000 V/m}\n",
        "place.position_gain 100000 V/m makes joint 'boom' oscillate.*at most 393\\d V/m",
    ),
    (
        "centre: 3 mm}",
        "centre: 3 mm, centring: {position_gain: 2 V/mm}}",
        "position_gain 2000 V/m makes the piston oscillate.*at most 30\\d V/m",
    ),
]


@pytest.mark.parametrize(("old", "new", "message"), REFUSED)
def test_what_the_rig_does_not_allow_is_refused(old: str, new: str, message: str, rig: Rig) -> None:
    with pytest.raises(InputError, match=message):
        plan_of(TEXT.replace(old, new), rig)


def test_what_the_place_cannot_do_is_refused_with_file_and_line(rig: Rig) -> None:
    text = TEXT.replace("joints: 2\n", "joints: 2\nplace: {limit: 5 V}\n")
    line = 1 + text.splitlines().index("place: {limit: 5 V}")
    with pytest.raises(InputError, match=rf"^mine\.yaml:{line}: protocol 'mine': place.limit 5 V"):
        resolve(read_protocol(text, "mine.yaml"), rig)


def test_a_centring_loop_settles_up_to_its_largest_gain_with_oil_and_load(rig: Rig) -> None:
    """The poles of s^3 + 2 d w s^2 + w^2 s + w^2 k cross to the right there, w of a simulation."""
    b, joint, speed = rig.nominal["b"], rig.joints[1], piston_gain(rig, 1)
    cylinder, lever = joint.cylinder, float(joint.geometry(0.0)[1])
    # The piston moved by a micrometre with both ports closed: pressures, force, frequency.
    step = 1e-6
    cap, rod = (-b * (v[1] - v[0]) / v[0] for v in rig.chamber_volumes(1, np.array([0.0, step])))
    force = cylinder.cap_area * cap - cylinder.rod_area * rod
    w = math.sqrt(-force / step * lever**2 / rig.nominal["M2"])
    gain = largest_centring_gain(rig, 1)
    for share, side in ((0.99, -1.0), (1.01, 1.0)):
        poles = np.roots([1.0, 2 * OIL_DAMPING * w, w**2, w**2 * share * gain * speed])
        assert side * max(poles.real) > 0.0


def with_valve(rig: Rig, rate: float, hertz: float, damping: float) -> Rig:
    valve = {"natural_frequency": hertz, "damping_ratio": damping}
    joints = tuple(
        j.model_copy(update={"valve": j.valve.model_copy(update=valve)}) for j in rig.joints
    )
    return rig.model_copy(update={"joints": joints, "sample_rate": rate})


@pytest.mark.parametrize(
    ("rate", "hertz", "damping"),
    [(50, 100, 0.8), (1000, 100, 0.8), (200, 60, 0.5), (1000, 30, 1.2)],
)
def test_a_position_loop_settles_below_its_largest_gain_and_not_above(
    rate: float, hertz: float, damping: float, rig: Rig
) -> None:
    """Against the loop's motion, integrated step by step."""
    changed = with_valve(rig, rate, hertz, damping)
    most, speed, w = largest_position_gain(changed, 0), piston_gain(changed, 0), math.tau * hertz

    def left(gain: float) -> float:
        piston, spool, rush, steps = 1e-3, 0.0, 0.0, math.ceil(40 * w / rate)
        h = 1.0 / (rate * steps)
        farthest = 0.0
        for sample in range(300):
            command = -gain * piston
            for _ in range(steps):  # semi-implicit Euler
                rush += h * (w**2 * (command - spool) - 2.0 * damping * w * rush)
                spool += h * rush
                piston += h * speed * spool
            farthest = max(farthest, abs(piston)) if sample > 250 else farthest
        return farthest

    assert left(0.85 * most) < 1e-3 < left(1.15 * most)


def test_the_largest_gain_of_a_fast_computer_and_of_a_fast_valve_are_the_textbooks(
    rig: Rig,
) -> None:
    fast = with_valve(rig, 1e6, 50.0, 0.7)
    routh = 2 * 0.7 * math.tau * 50.0  # of s^3/w^2 + 2 damping s^2/w + s + gain speed
    assert largest_position_gain(fast, 0) * piston_gain(fast, 0) == pytest.approx(routh, rel=1e-2)
    stiff = with_valve(rig, 100.0, 1e4, 0.7)
    assert largest_position_gain(stiff, 0) * piston_gain(stiff, 0) == pytest.approx(200, rel=1e-2)


def test_a_command_beyond_the_spools_stroke_is_refused(rig: Rig) -> None:
    joints = tuple(
        j.model_copy(update={"valve": j.valve.model_copy(update={"spool_stroke": 0.05})})
        for j in rig.joints
    )
    stiff = rig.model_copy(update={"joints": joints})
    with pytest.raises(InputError, match=r"moves the spool 0.1 V; its stroke is 0.05 V"):
        plan_of(TEXT, stiff)


def test_a_rig_of_another_size_is_refused(rig: Rig) -> None:
    single = rig.model_copy(update={"joints": rig.joints[:1]})
    for name in shipped_names():
        with pytest.raises(InputError, match=r"is for 2 joint\(s\), rig 'shinshu-2dof' has 1"):
            resolve(load(name), single)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"repeats": 0}, "repeats is 0"),
        ({"repeats": 10**9}, "repeats is 1000000000; expected 1 to 1000"),
        ({"amplitude_scale": -1.0}, "amplitude's scale is -1"),
        ({"seed": -3}, "seed is -3"),
        ({"steps": ("step9",)}, "no step 'step9'; it has: step1"),
        ({"duration": 1.3}, "duration 1.3 s is 2.6 periods"),
    ],
)
def test_an_override_that_does_not_fit_is_refused(
    overrides: dict[str, object], message: str, rig: Rig
) -> None:
    with pytest.raises(InputError, match=message):
        plan_of(TEXT, rig, **overrides)
