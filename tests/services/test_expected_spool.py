"""The spool expected under held commands, against scipy's discretisation of the same equation."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter

from rig.bench.checks.expected_spool import ExpectedSpool
from rig.model.parts import Valve
from rig.model.rig import Rig
from rig.runs.rigs import load_rig


def rig_with(damping_ratio: float) -> Rig:
    rig = load_rig("shinshu-2dof")
    valve = rig.joints[0].valve.model_copy(update={"damping_ratio": damping_ratio})
    joints = tuple(joint.model_copy(update={"valve": valve}) for joint in rig.joints)
    return rig.model_copy(update={"joints": joints})


def response(valve: Valve, commands: np.ndarray, rate: float) -> np.ndarray:
    w = 2.0 * math.pi * valve.natural_frequency
    b, a, _ = cont2discrete(([w * w], [1.0, 2.0 * valve.damping_ratio * w, w * w]), 1.0 / rate)
    wanted = np.clip(valve.spool_gain * commands, -valve.spool_stroke, valve.spool_stroke)
    rest = wanted[0]
    b = b.ravel()
    z2 = (b[2] - a[2]) * rest
    return lfilter(b, a, wanted, zi=[(b[1] - a[1]) * rest + z2, z2])[0]


@pytest.mark.parametrize("damping_ratio", [0.3, 1.0, 2.0])
def test_the_spool_follows_held_commands_however_the_blocks_are_cut(damping_ratio: float) -> None:
    rig = rig_with(damping_ratio)
    commands = np.repeat(np.random.default_rng(1).uniform(-12.0, 12.0, (50, 2)), 4, axis=0)
    expected = ExpectedSpool(rig)
    in_blocks = np.hstack([expected.follow(part.T) for part in np.split(commands, [9, 10, 20])]).T
    for j, joint in enumerate(rig.joints):
        assert in_blocks[:, j] == pytest.approx(
            response(joint.valve, commands[:, j], rig.sample_rate), abs=1e-11
        )
