"""One equation's rows of a set of records, their variables, and fits to their residual."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.effects.contact import contact_state
from analysis.regression.conditioned import ConditionedRecord
from analysis.regression.least_squares import shortest
from analysis.regression.rows import Rows
from analysis.signals.conditioning import Signals
from analysis.terms.base import joint_of
from analysis.trace.data.conditioned_record import filtered, prepared_signals
from analysis.trace.data.regression_data import RegressionData
from analysis.trace.search.linear_fit import orthonormal
from analysis.trace.settings import CLUES
from rig.model import channels as ch
from rig.model.rig import Rig

Array = NDArray[np.float64]


@dataclass(frozen=True)
class EquationPart:
    """A record's rows of one equation, signals as the model's terms see them, whitening weight."""

    conditioned: ConditionedRecord
    rows: Rows
    signals: Signals
    weight: float


@dataclass(frozen=True)
class EquationRows:
    """The rows of one equation in a set of records.

    `residual` (m,) is whitened and orthogonal to the model's orthonormal `base` (m, r).
    """

    parts: tuple[EquationPart, ...]
    residual: Array
    base: Array


def equation_rows(data: RegressionData, residual: Array, equation: str) -> EquationRows | None:
    """Return the rows of an equation with its `residual` (M,), None where it has no rows."""
    parts, residuals, base = [], [], []
    for s in data.segments:
        if s.equation != equation:
            continue
        conditioned, rows = data.source(s)
        signals = prepared_signals(data.rig, data.terms, conditioned)
        weight = float(np.sqrt(s.repeats)) / s.noise
        parts.append(EquationPart(conditioned, rows, signals, weight))
        residuals.append(residual[s.where])
        base.append(data.base[s.where])
    if not parts:
        return None
    B = orthonormal(np.concatenate(base))
    r = np.concatenate(residuals)
    return EquationRows(tuple(parts), r - B @ (B.T @ r), B)


@dataclass(frozen=True)
class EquationSides:
    """One equation's rows of training records and of held-out ones."""

    rig: Rig
    equation: str
    train: EquationRows
    held_out: EquationRows

    @property
    def joint(self) -> int:
        """The equation's joint, 0-based."""
        return joint_of(self.equation)

    @property
    def parts(self) -> tuple[EquationPart, ...]:
        """The records' rows of both sides."""
        return (*self.train.parts, *self.held_out.parts)

    @property
    def travel(self) -> float:
        """The joint's largest travel [m, rad] in one record."""
        return max(float(np.ptp(p.conditioned.signals.s[:, self.joint])) for p in self.parts)

    def columns(self, columns: Sequence[Array]) -> tuple[Array, Array]:
        """Return `whitened_columns` of either side, of columns (n, k) for each of `parts`."""
        count = len(self.train.parts)
        first, second = columns[:count], columns[count:]
        return whitened_columns(self.train, first), whitened_columns(self.held_out, second)


def whitened_columns(side: EquationRows, columns: Sequence[Array]) -> Array:
    """Return columns (m, k): filtered like the rows, whitened, orthogonal to the model's own.

    `of_part` holds the unfiltered columns (n, k) of each part.
    """
    whitened = []
    for part, of_part in zip(side.parts, columns, strict=True):
        named = {str(k): of_part[:, k] for k in range(of_part.shape[1])}
        clue_columns = filtered(named, part.conditioned, part.rows)
        whitened.append(np.column_stack(list(clue_columns.values())) * part.weight)
    D = np.concatenate(whitened)
    return np.asarray(D - side.base @ (side.base.T @ D))


def fitted_coefficients(columns: Array, side: EquationRows) -> Array:
    """Return the least-squares coefficients (k,) of columns (m, k) for a residual."""
    return shortest(columns, side.residual, 1e-2)


def explained_share(
    fitted_columns: Array, side: EquationRows, judged_columns: Array, other: EquationRows
) -> float:
    """Return the share of energy above noise in `other` that columns fitted to `side` remove.

    `fitted_columns` and `judged_columns` are the same columns on either rows.
    """
    coefficients = fitted_coefficients(fitted_columns, side)
    residual = other.residual
    before = float(residual @ residual) - len(residual)
    after = float(np.sum((residual - judged_columns @ coefficients) ** 2)) - len(residual)
    return min(1.0, (before - after) / before) if before > 0 else 0.0


@dataclass(frozen=True)
class Factor:
    """A factor of a curve: the `variable` that it is computed from, and the factor in `words`."""

    variable: str
    words: str


def factors(equation: str) -> dict[str, Factor]:
    """Return the factors of an equation's curves by name."""
    kind, number = equation.rsplit("_", 1)
    velocity = f"velocity_{number}"
    if kind == "torque":
        return {
            "direction": Factor(velocity, f"the direction of {velocity}"),
            "memory": Factor(velocity, f"the direction of {velocity} with memory"),
            velocity: Factor(velocity, velocity),
        }
    difference, spool = f"pressure_difference_{number}", ch.channel(ch.SPOOL, int(number))
    return {name: Factor(name, name) for name in (difference, spool)}


def factor_of(name: str, signals: Signals, joint: int, travel: float) -> Array:
    """Return the factor `direction` or `memory` (n,); `travel` [m, rad] is the joint's largest."""
    if name == "direction":
        speed = signals.sd[:, joint]
        rms = float(np.sqrt(np.mean(speed**2)))
        return np.asarray(np.tanh(speed / max(CLUES.direction_speed * rms, 1e-12)))
    place = np.ascontiguousarray(signals.s[:, joint])
    return np.asarray(contact_state(place, max(CLUES.direction_memory * travel, 1e-12)))


def variables(rig: Rig, signals: Signals, joint: int) -> dict[str, Array]:
    """Return the variables (n,) that a residual of a joint (0-based) may depend on, by name."""
    i, cap, rod = joint, signals.p_cap[:, joint], signals.p_rod[:, joint]
    if rig.electric:
        return {
            ch.channel(ch.POSITION, i + 1): signals.q[:, i],
            f"velocity_{i + 1}": signals.qd[:, i],
            f"acceleration_{i + 1}": signals.qdd[:, i],
            ch.channel(ch.DRIVE, i + 1): signals.u[:, i],
            "time": signals.t,
        }
    return {
        ch.channel(ch.PISTON, i + 1): signals.s[:, i],
        f"velocity_{i + 1}": signals.sd[:, i],
        f"acceleration_{i + 1}": np.gradient(signals.sd[:, i]) * signals.rate,
        ch.channel(ch.CAP, i + 1): cap,
        ch.channel(ch.ROD, i + 1): rod,
        f"pressure_difference_{i + 1}": cap - rod,
        ch.channel(ch.SPOOL, i + 1): signals.u[:, i],
        ch.SUPPLY: signals.p_s,
        ch.TEMPERATURE: signals.temperature,
        "time": signals.t,
    }
