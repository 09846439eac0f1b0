"""The numbers that the paper prints, as data in SI, for comparison.

Source: Sakai and Maeshima, "A new method for parameter identification for N-DOF hydraulic robots",
Table III (identified results) and Table IV (FIT ratio). Units follow docs/method.md: the
paper prints Fv in N s/m, which is N m s/rad, and the gains in m^2/(s V sqrt(Pa)), which is m^3/...
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

RIG: Final = "shinshu-2dof"  # the only rig that these numbers belong to
REPEATS: Final = 10


@dataclass(frozen=True)
class PaperParameter:
    """One row of Table III in SI; `rsd` [%] over ten experiments; None where the paper has a dash.

    `nominal` is a range where the paper gives one.
    """

    low: float
    mean: float
    high: float
    rsd: float
    pso: float | None = None
    ga: float | None = None
    nominal: tuple[float, ...] = ()


def _gain(low: float, mean: float, high: float, rsd: float, *searched: float) -> PaperParameter:
    """Return a flow gain that the paper prints in 1e-7; `searched` are PSO and GA."""
    pso, ga = (*(value * 1e-7 for value in searched), None, None)[:2]
    return PaperParameter(low * 1e-7, mean * 1e-7, high * 1e-7, rsd, pso, ga)


TABLE_III: Final[Mapping[str, PaperParameter]] = {
    "M1": PaperParameter(4.43, 4.47, 4.52, 0.52, nominal=(5.00,)),
    "M2": PaperParameter(1.25, 1.27, 1.32, 1.71, 0.50, 3.20, (1.00,)),
    "R12": PaperParameter(1.33, 1.37, 1.38, 0.94, nominal=(1.50,)),
    "Fv1": PaperParameter(49.79, 50.77, 51.03, 0.74),
    "Fv2": PaperParameter(4.22, 4.43, 4.51, 1.82, 1.70, 16.36),
    "W1": PaperParameter(8.52, 8.55, 8.60, 0.31, nominal=(8.60,)),
    "W2": PaperParameter(3.27, 3.30, 3.36, 0.71, 1.33, 13.15, (3.00,)),
    "b": PaperParameter(225e6, 233e6, 238e6, 2.15, 317e6, 246e6, (200e6, 1700e6)),
    "C_pp_1": _gain(6.28, 6.31, 6.33, 0.32),
    "C_pm_1": _gain(6.58, 6.60, 6.62, 0.14),
    "C_mp_1": _gain(5.45, 5.50, 5.54, 0.52),
    "C_mm_1": _gain(6.23, 6.27, 6.32, 0.41),
    "C_pp_2": _gain(6.26, 6.28, 6.32, 0.34, 2.39, 6.76),
    "C_pm_2": _gain(5.34, 5.36, 5.39, 0.38, 2.41, 6.17),
    "C_mp_2": _gain(5.40, 5.44, 5.47, 0.37, 2.38, 6.97),
    "C_mm_2": _gain(6.16, 6.19, 6.21, 0.24, 2.43, 9.04),
}

# Section IV.B: condition numbers "at most" / "at least" over the experiments, rows, solve time.
CONDITION: Final[Mapping[str, tuple[float, float]]] = {"mechanical": (10, 11), "fluid": (25, 27)}
ROWS: Final[Mapping[str, int]] = {"mechanical": 12000, "fluid": 24000}
SOLVE_SECONDS: Final = 6.5

Triple = tuple[float, float, float]  # FIT [%] of s, p_cap, p_rod


@dataclass(frozen=True)
class PaperFit:
    """One column of Table IV: the record's step here, the excited joint, FIT of s, p_cap, p_rod.

    `fit` is None where the paper shows a figure but prints no number (both joints at once).
    """

    step: str
    joint: int
    fit: Triple | None
    figure: str = ""


TABLE_IV: Final[tuple[PaperFit, ...]] = (
    PaperFit("step1_1hz", 2, (91.7, 33.6, 35.1), "Fig. 6"),
    PaperFit("step1_3hz", 2, (45.8, 45.5, 2.8)),
    PaperFit("step2_1hz", 1, (81.1, 40.2, 69.4), "Fig. 7"),
    PaperFit("step2_3hz", 1, (45.8, 67.4, 47.1)),
    PaperFit("step3_1hz", 1, (60.9, 50.7, 61.3), "Fig. 8"),
    PaperFit("step3_3hz", 1, (51.0, 64.0, 57.1)),
    PaperFit("both_1hz", 1, None, "Fig. 9"),
    PaperFit("both_1hz", 2, None, "Fig. 10"),
    PaperFit("both_3hz", 1, None),
    PaperFit("both_3hz", 2, None),
)
# The search methods that the paper compares with, on STEP1 at 1 Hz.
TABLE_IV_SEARCH: Final[Mapping[str, Triple]] = {
    "PSO": (-2.4, 5.1, -7.2),
    "GA": (52.6, -743.7, -1.0e4),
}
