"""What else has the force of a sensor's error is stated with its size."""

from __future__ import annotations

import re

import numpy as np
import pytest
from scipy.signal import lsim

from analysis.effects.measurement import Sensor
from analysis.terms import make
from rig.model.rig import Rig
from rig.runs.rigs import load_rig
from tests.analysis.test_terms import signals_of


def test_the_gain_of_all_chamber_sensors_that_would_do_the_same_is_stated(rig: Rig) -> None:
    """Both meet the same flow balance of the cap chamber and the same balance of forces."""
    supply = make("sensor_gain", "bench")
    said = supply.remark(rig, [], (0.94, 0.0))  # type: ignore[attr-defined]
    inverse, force, flow = (float(x) for x in re.findall(r"\d\.\d+", said))
    b, c, V, u, piston = 1e9, 3e-8, 4e-4, 2.0, 1e-4  # SI; piston: the flow that it displaces
    p, p_s, rate = 4e6, 7e6, 8e7  # true pressures, if the chambers' sensors are right
    left = c * u * np.sqrt(p_s - p) - piston - V / b * rate
    # If not, the readings of the chambers are `inverse` times the true pressures.
    true, true_rate, true_supply = p / inverse, rate / inverse, 0.94 * p_s
    other = flow * c * u * np.sqrt(true_supply - true) - piston - V / (force * b) * true_rate
    assert other == pytest.approx(left, rel=1e-3)
    assert true == pytest.approx(force * p, rel=1e-3)


@pytest.mark.parametrize(
    ("name", "shape"), [("sensor_gain", (0.93, 0.0)), ("sensor_crosstalk", (-0.04,))]
)
@pytest.mark.parametrize("side", ["cap", "rod"])
def test_an_area_that_would_do_the_same_is_stated(
    rig: Rig, name: str, shape: tuple[float, ...], side: str
) -> None:
    """With it the readings balance the same load as the true pressures do with the file's areas."""
    rng = np.random.default_rng(5)
    q = np.array([[1.13, -1.44]]) + rng.uniform(-0.1, 0.1, (50, 2))
    readings = signals_of(rig, q, np.zeros_like(q), np.zeros_like(q), rng)
    error = make(name, f"joint 2 {side}")
    true = error.prepare(rig, readings, shape)
    cylinder = rig.joints[1].cylinder
    force = cylinder.cap_area * true.p_cap[:, 1] - cylinder.rod_area * true.p_rod[:, 1]
    said = error.remark(rig, [readings], shape)  # type: ignore[attr-defined]
    found = re.match(r"a (cap|rod) area ([\d.]+) % (larger|smaller) than the rig file's", said)
    assert found
    which, percent, way = found.groups()
    ratio = 1.0 + float(percent) / (100.0 if way == "larger" else -100.0)
    area = {f"{which}_area": ratio * getattr(cylinder, f"{which}_area")}
    right = cylinder.model_copy(update=area)
    other = right.cap_area * readings.p_cap[:, 1] - right.rod_area * readings.p_rod[:, 1]
    assert other == pytest.approx(force, abs=0.01 * float(np.std(force)))


def test_a_lag_is_undone_without_multiplying_the_noise_of_the_samples(rig: Rig) -> None:
    """16 ms at 1 kHz: differences of samples would give 11 times the noise."""
    rate, tau, noise = 1000.0, 16e-3, 1.6e4
    time = np.arange(4000) / rate
    true = 5e6 + 1e6 * np.sin(2 * np.pi * 3.0 * time) + 3e5 * np.sin(2 * np.pi * 11.0 * time)
    _, lagged, _ = lsim(([1.0], [tau, 1.0]), true - true[0], time)
    reading = true[0] + lagged + noise * np.random.default_rng(3).standard_normal(len(time))
    error = make("sensor_lag", "joint 1 cap")
    assert isinstance(error, Sensor)
    corrected = error.correct(rig, {"cap_pressure_1": reading}, rate, (tau,))["cap_pressure_1"]
    inner = slice(200, -200)
    rms = float(np.sqrt(np.mean((corrected - true)[inner] ** 2)))
    assert rms < 3.0 * noise
    assert rms < 0.2 * float(np.sqrt(np.mean((reading - true)[inner] ** 2)))


@pytest.mark.parametrize("poles", [(4e-3, 4e-3), (6e-3, 2e-3), (8e-3, 0.0)])
def test_a_lag_with_a_second_pole_is_undone(rig: Rig, poles: tuple[float, float]) -> None:
    rate, (one, two) = 1000.0, poles
    time = np.arange(4000) / rate
    true = 1e6 * np.sin(2 * np.pi * 3.0 * time) + 3e5 * np.sin(2 * np.pi * 11.0 * time)
    _, reading, _ = lsim(([1.0], [one * two, one + two, 1.0]), true, time)
    shape = (one + two, one * two / (one + two) ** 2)
    error = make("sensor_lag", "joint 1 cap")
    assert isinstance(error, Sensor)
    sampled = error.correct(rig, {"cap_pressure_1": reading}, rate, shape)["cap_pressure_1"]
    inner = slice(200, -200)
    for corrected in (sampled, error.undone(reading, 0, rate, shape)):
        assert corrected[inner] == pytest.approx(true[inner], abs=5e3)
    alone = error.undone(reading, 0, rate, shape[:1])[inner]
    assert (float(np.abs(alone - true[inner]).max()) > 1.5e4) == (two > 0.0)


def test_a_position_half_a_sample_late_may_be_a_held_command() -> None:
    rig = load_rig("emps")
    for name in ("channel_delay", "sensor_lag"):
        effect = make(name, "joint 1 position")
        assert isinstance(effect, Sensor)
        assert "held for a sample" in effect.remark(rig, [], (0.49 / rig.sample_rate,))
        assert effect.remark(rig, [], (2.0 / rig.sample_rate,)) == ""


def test_a_piston_sensor_is_corrected_no_further_than_its_pins_allow(rig: Rig) -> None:
    """Extended, the cylinder is 1 mm shorter than both pin distances: a gain tried leads beyond."""
    joint = rig.joints[0]
    pins, stroke = joint.linkage, joint.cylinder.stroke
    middle = pins.base_pin + pins.arm_pin - 0.5 * stroke - 1e-3
    stretched = joint.model_copy(update={"linkage": pins.model_copy(update={"mid_length": middle})})
    lever = rig.model_copy(update={"joints": (stretched, *rig.joints[1:])})
    t = np.arange(400) / 1000.0
    s = 0.49 * stroke * np.sin(2 * np.pi * 3 * t)
    q = np.column_stack((stretched.geometry(s)[0], np.full(len(t), -1.4)))
    qd = np.gradient(q, 1e-3, axis=0)
    signals = signals_of(lever, q, qd, np.gradient(qd, 1e-3, axis=0), np.random.default_rng(0))
    for name, shape in (("sensor_gain", (1.3, 0.0)), ("sensor_offset", (0.1 * stroke,))):
        effect = make(name, "joint 1 piston")
        assert isinstance(effect, Sensor)
        seen = effect.prepare(lever, signals, shape)
        assert seen.s[:, 0].max() < 0.5 * stroke + 1e-3
        for field in ("q", "qd", "qdd", "G", "theta", "V_cap"):
            assert np.isfinite(getattr(seen, field)).all(), field
