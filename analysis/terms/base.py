"""A term: columns of the regression and, in simulation, a part of the right-hand side.

A model is a list of terms. A new effect is a frozen dataclass derived from `Term`, listed in
`TERMS` of a module of one of the packages `analysis.terms.PACKAGES`; nothing else changes.

Sign convention of every row: sum of columns times coefficients = right-hand side, with
right-hand sides G F (torque_i), + A_cap ds/dt (flow_cap_i), - A_rod ds/dt (flow_rod_i).

Simulation. Each term has a kernel, a plain function of fixed signature that numba can compile:

    kernel(phase, bench, x, z, par, out, M, dz) -> None
    phase  PREPARE: may change `bench` and `x` (what all terms see: dead band, supply sag);
           CONTRIBUTE: adds to `out`, `M`, `dz`
    bench  (4,) by TIME, P_S, P_TANK, TEMPERATURE
    x      (X_ROWS, N) by Q, QD, THETA, G, S, SD, U, P_CAP, P_ROD, V_CAP, V_ROD
    z, dz  hidden states of this term and their rates, (hidden(rig),)
    par    what `pack` made of coefficients and shape
    out    (OUT_ROWS, N): TORQUE generalised torque on the joint [N m], FLOW_CAP, FLOW_ROD flow
           into the chamber [m^3/s], COMP_CAP, COMP_ROD compressibility V/b [m^3/Pa]
    M      (N, N) inertia in joint coordinates [kg m^2]

A kernel is used in two ways with equal results. A model that is simulated seldom calls each kernel
by its address (`analysis.simulation.interpreted`). For one that is simulated often, source is
generated from the kernels' source and compiled once (`analysis.simulation.fused`). This requires a
kernel of loops over joints, `if`, assignments, functions of `math` and `numpy`, and functions
marked `njit`; an index must come from a loop or be `int(par[k])`, where `par[k]` is a joint
(0-based) and not a parameter. Any other kernel is called by its address only.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Final

import numpy as np
from numba import cfunc, types
from numpy.typing import NDArray

from analysis.signals.conditioning import Mask, Signals
from rig.model.parse import InputError
from rig.model.rig import Rig

Array = NDArray[np.float64]
Columns = dict[str, dict[str, Array]]  # equation -> coefficient name -> column (n,)

PREPARE: Final = 0
CONTRIBUTE: Final = 1
TIME, P_S, P_TANK, TEMPERATURE = range(4)
Q, QD, THETA, G, S, SD, U, P_CAP, P_ROD, V_CAP, V_ROD = range(11)
X_ROWS: Final = 11
TORQUE, FLOW_CAP, FLOW_ROD, COMP_CAP, COMP_ROD = range(5)
OUT_ROWS: Final = 5

_VECTOR, _MATRIX = types.float64[::1], types.float64[:, ::1]
KERNEL_SIGNATURE = types.void(
    types.int64, _VECTOR, _MATRIX, _VECTOR, _VECTOR, _MATRIX, _MATRIX, _VECTOR
)
FAMILIES: Final = {"mechanical": ("torque",), "fluid": ("flow_cap", "flow_rod")}


class Kernel:
    """A term's kernel, compiled (or read from numba's cache) when its address is first needed."""

    def __init__(self, function: Callable[..., None]) -> None:
        self.function = function

    @functools.cached_property
    def address(self) -> int:
        """Machine address of the compiled function."""
        compiled = cfunc(KERNEL_SIGNATURE, cache=True, error_model="numpy")(self.function)
        self._compiled = compiled  # the code lives as long as this object
        return int(compiled.address)


def kernel(function: Callable[..., None]) -> Kernel:
    """Mark a function as a term's kernel (see the module for its signature)."""
    return Kernel(function)


@dataclass(frozen=True)
class Coefficient:
    """A linear unknown of one family's rows and the parameter that it represents.

    `family` is `mechanical` (torque rows) or `fluid` (chamber-flow rows). With `reciprocal` the
    rows' coefficient is 1/parameter (1/b in the rows, b in results).
    """

    parameter: str
    unit: str
    family: str
    reciprocal: bool = False


@dataclass(frozen=True)
class ParameterReduction:
    """Linear unknowns x = h(p) of fewer parameters p: names of both, a start, h and dh/dp.

    `start` maps x (k,) to p (m,); `value` maps p to x; `slope` maps p to (k, m).
    """

    linear: tuple[str, ...]
    parameters: tuple[str, ...]
    start: Callable[[Array], Array]
    value: Callable[[Array], Array]
    slope: Callable[[Array], Array]


@dataclass(frozen=True)
class Term:
    """One effect at one place; a subclass sets `name` and overrides methods as needed.

    `where` is `bench`, `joint I` or `joint I cap|rod`.
    """

    name: ClassVar[str]
    kernel: ClassVar[Kernel]  # the compiled contribution in simulation (see the module)
    prepares: ClassVar[bool] = False  # whether the kernel acts in phase PREPARE
    rate_tolerance: ClassVar[float] = 1e-5  # [rad/s] that the integrator needs for this term
    where: str = "bench"

    @property
    def key(self) -> tuple[str, str]:
        """The term's name and place, which identify it in a model."""
        return self.name, self.where

    def coefficients(self, rig: Rig) -> tuple[Coefficient, ...]:
        """Return the linear unknowns, in the order of `pack`."""
        raise NotImplementedError

    def parameters(self, rig: Rig) -> tuple[Coefficient, ...]:
        """Return the model's parameters (default: the linear unknowns themselves)."""
        return self.coefficients(rig)

    @classmethod
    def places(cls, rig: Rig) -> tuple[str, ...]:
        """Return every `where` of this term on a rig."""
        return ("bench",)

    def reduction(self, rig: Rig) -> ParameterReduction | None:
        """Return how the linear unknowns depend on fewer parameters, None if they do not."""
        return None

    @property
    def joint(self) -> int:
        """The joint, 0-based, of `joint I`; raises InputError for another `where`."""
        words = self.where.split()
        if len(words) != 2 or words[0] != "joint" or not words[1].isdecimal() or words[1] == "0":
            raise InputError(f"term {self.name!r}: where {self.where!r} is not like 'joint 1'")
        return int(words[1]) - 1

    def shape_names(self) -> tuple[str, ...]:
        """Name the shape parameters (0 to 2) that enter nonlinearly."""
        return ()

    def prepare(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Signals:
        """Return the signals as all terms should see them (default: unchanged)."""
        return signals

    def columns(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Columns:
        """Return the columns, each (n,), by equation and parameter; absent ones are zero.

        Only the equations of the excited joints (`Signals.excited_joints`) need to be among them.
        """
        raise NotImplementedError

    def valid(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Mapping[str, Mask]:
        """Return, by equation, the samples (n,) at which the term is valid (default: all)."""
        return {}

    def tolerance(self, shape: Sequence[float]) -> float:
        """Return the tolerance of joint rates [rad/s] that the integrator needs for this term."""
        return self.rate_tolerance

    def hidden(self, rig: Rig) -> int:
        """Return the number of hidden states that the kernel integrates."""
        return 0

    def hidden_path(
        self, rig: Rig, signals: Signals, values: Mapping[str, float], shape: Sequence[float]
    ) -> Array:
        """Return the hidden states (n, hidden(rig)) along measured signals, in the kernel's units.

        They are the initial states of simulations that start during a motion.
        """
        return np.zeros((len(signals.t), self.hidden(rig)))

    def fastest(self, shape: Sequence[float]) -> float:
        """Return the fastest rate [1/s] at which a hidden state relaxes (0: none does)."""
        return 0.0

    def pack(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> Array:
        """Return the kernel's `par` (default: coefficients as in the rows, then the shape)."""
        linear = [
            1.0 / values[c.parameter] if c.reciprocal else values[c.parameter]
            for c in self.parameters(rig)
        ]
        return np.array([*linear, *shape], dtype=np.float64)


def equation(kind: str, joint: int) -> str:
    """Name an equation, joint 0-based: ``equation("flow_cap", 0)`` is ``flow_cap_1``."""
    return f"{kind}_{joint + 1}"


def joint_of(name: str) -> int:
    """Return the joint, 0-based, of an equation's name."""
    return int(name.rsplit("_", 1)[1]) - 1


def family_of(name: str) -> str:
    """Return the family, `mechanical` or `fluid`, of an equation's name."""
    kind: Any = name.rsplit("_", 1)[0]
    return next(family for family, kinds in FAMILIES.items() if kind in kinds)


@dataclass(frozen=True)
class Used:
    """A term of a model together with its fitted shape parameters."""

    term: Term
    shape: tuple[float, ...] = ()


def inverted(rig: Rig, terms: Sequence[Used], values: Mapping[str, float]) -> dict[str, float]:
    """Convert parameters into the rows' coefficients or back: b [Pa] and 1/b change places."""
    reciprocal = {c.parameter for u in terms for c in u.term.coefficients(rig) if c.reciprocal}
    return {name: 1.0 / v if name in reciprocal and v else v for name, v in values.items()}
