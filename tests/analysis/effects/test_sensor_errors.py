"""What else has the force of a sensor's error is stated with its size."""

from __future__ import annotations

import re

import numpy as np
import pytest

from analysis.terms import make
from rig.model.rig import Rig
from tests.analysis.test_terms import signals_of


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
