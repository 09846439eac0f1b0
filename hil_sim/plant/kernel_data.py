"""The flat tables the compiled kernel reads: one row per joint, channel and law, SI throughout."""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rig.model import channels as ch

ATMOSPHERE: Final = 101_325.0  # absolute zero is this far below gauge zero [Pa]
KIND: Final = {
    name: i
    for i, name in enumerate((ch.SPOOL, ch.PISTON, ch.CAP, ch.ROD, ch.SUPPLY, ch.TEMPERATURE))
}
_KERNELS: Final = ("kernel.py", "kernel_loop.py", "kernel_data.py")
LEAK_WIDENING: Final = 1e-8  # the clearance a leak passes opens with its pressure [1/Pa]
# A table is a numpy structured array; its rows are read as records by the compiler.
Table = NDArray[Any]


def _stamp() -> str:
    # The compiler's cache of a function is keyed by the date of that function's own file and by
    # its arguments' types. A field named after all kernels' text makes it miss when any changes.
    text = b"".join(Path(__file__).with_name(f).read_bytes() for f in _KERNELS)
    return f"stamp_{zlib.crc32(text):08x}"


def _records(integers: str, floats: str) -> np.dtype[np.void]:
    fields: list[Any] = [(name, np.int64) for name in [_stamp(), *integers.split()]]
    return np.dtype((np.record, [*fields, *((name, np.float64) for name in floats.split())]))


JOINT: Final = _records(
    "",
    # linkage: a^2 + c^2, a c, then the offset and its sine and cosine
    "pins product mid_length half_stroke offset sin_offset cos_offset "
    # volumes are those at mid-stroke, dead volume included
    "cap_area rod_area cap_volume rod_volume c_pp c_pm c_mp c_mm "
    "leak_internal leak_length leak_cap leak_rod "
    # spool and its edges
    "omega zeta spool_stroke spool_rate spool_gain null opening_rate lap_ahead lap_astern rounding "
    "notch "
    # mechanics: weight is W g
    "viscous weight spring spring_rest spring_hardening torque_offset "
    "contact_stiffness contact_damping "
    "friction_plus friction_minus stribeck stribeck_speed friction_pressure friction_scale "
    "friction_taper friction_width friction_corner bristle_stiffness bristle_damping "
    "bristle_limit drag_plus drag_minus drag_thinning drag_lever "
    "wave_torque wave_rate wave_form wave_now play play_travel "
    "output_top output_range",
)
BENCH: Final = _records(
    "",
    "half_bulk trapped air air_dissolution air_exponent laminar laminar_form sin_slope "
    "cos_slope "
    "pump supply_volume relief_crack relief_slope relief_rounding "
    "line_gain line_laminar manifold_volume "
    "tank_pressure tank_resistance tank_laminar tank_lag "
    "temperature band period_1 phase_1 period_2 phase_2 bulk_temperature viscosity_temperature",
)
CHANNEL: Final = _records(
    "kind joint filter_stages crosstalk_source",
    "noise gain offset lag low step scale top filter_time filter_before filter_first filter_second "
    "filter_started crosstalk_share crosstalk_high_pass crosstalk_slow",
)
LAW: Final = _records("start first period", "gain bias position_gain setpoint limit")


def record(table: Table) -> Any:
    """Return the only row of a one-row table."""
    return table[0]
