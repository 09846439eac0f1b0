"""A plant whose answer is known by heart: each piston's speed is proportional to its voltage.

Run as a program it is a whole simulated bench in a process of its own:
``python -m tests.hil_sim.integrator realtime|virtual [parent [wire]]`` prints its endpoint.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from functools import cache
from importlib import resources
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil_sim.device.lifetime import ParentProcess
from hil_sim.device.server import serve
from rig.model import channels as ch
from rig.model.parse import parse_model
from rig.model.parts import Wire
from rig.model.rig import Rig
from rig.model.wire.codes import decode_output, encode_input, encode_output

SPEED_PER_VOLT = 0.02  # [m/(s V)]
PRESSURE = 2.0e6
SPOOL_PER_VOLT = 0.1
Codes = NDArray[np.int64]


@cache
def _shipped() -> Rig:
    text = (resources.files("rig") / "shipped" / "shinshu-2dof.yaml").read_text("utf-8")
    return parse_model(Rig, text, "shinshu-2dof.yaml")


def seed_rig(**wire: object) -> Rig:
    """The shipped two-joint rig, its wire changed where asked."""
    rig = _shipped()
    changed = Wire(**{**rig.wire.model_dump(), **wire})
    return rig.model_copy(update={"wire": changed})


class IntegratorPlant:
    """s_{k+1} = s_k + SPEED_PER_VOLT v_k / rate; the temperature's code counts the samples."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.tick = 0
        self.piston = [0.0] * len(rig.joints)
        self.volts = [0.0] * len(rig.joints)

    def advance(self, ticks: int, laws: Sequence[Any]) -> tuple[Codes, Codes]:
        """Measure, evaluate the law, hold the output for one sample; `ticks` times."""
        measured = np.zeros((ticks, len(self.rig.channels)))
        outputs = np.zeros((ticks, len(laws)), dtype=np.int64)
        count = np.arange(self.tick, self.tick + ticks) & 0xFFFF
        for row in range(ticks):
            for i, law in enumerate(laws):
                valve = self.rig.joints[i].valve
                measured[row, 4 * i : 4 * i + 4] = (
                    SPOOL_PER_VOLT * self.volts[i],
                    self.piston[i],
                    PRESSURE,
                    PRESSURE,
                )
                wave = law.wave[(self.tick - law.start) % len(law.wave)]
                pull = law.position_gain * (law.setpoint - self.piston[i])
                v = min(max(law.gain * wave + law.bias + pull, -law.limit), law.limit)
                top = (1 << (valve.command_bits - 1)) - 1
                code = round(v * top / valve.command_range)
                outputs[row, i] = code
                self.volts[i] = code * valve.command_range / top
                self.piston[i] += SPEED_PER_VOLT * self.volts[i] / self.rig.sample_rate
            self.tick += 1
        codes = np.empty(measured.shape, dtype=np.int64)
        for column, name in enumerate(self.rig.channels):
            kind = ch.kind_of(name)[0]
            sensor = self.rig.sensors.of(kind)
            codes[:, column] = encode_input(measured[:, column], *sensor.range, sensor.bits)
            if kind == ch.TEMPERATURE:
                codes[:, column] = count
        return codes, outputs


def expected_outputs(volts: NDArray[np.float64], rig: Rig, joint: int = 0) -> NDArray[np.float64]:
    """The voltages that a joint's converter makes of wanted ones."""
    valve = rig.joints[joint].valve
    codes = encode_output(volts, valve.command_range, valve.command_bits)
    return decode_output(codes, valve.command_range, valve.command_bits)


def main() -> None:
    """Serve the plant, print the endpoint first."""
    parent = ParentProcess(int(sys.argv[2])) if len(sys.argv) > 2 else None
    rig = seed_rig()
    serve(
        rig,
        IntegratorPlant(rig),
        realtime=sys.argv[1] == "realtime",
        on_ready=lambda endpoint: print(endpoint, flush=True),  # noqa: T201
        parent=parent,
        wire=sys.argv[3] if len(sys.argv) > 3 else "modbus-tcp",
    )


if __name__ == "__main__":
    main()
