"""The combinations of parameters that records determine, where not all are determined.

Rows [X] determine c'p exactly where c is orthogonal to the null space of X. With m null directions
m parameters are chosen to be *dependent* (columns that pivoted QR of the null space finds best
conditioned) and are regrouped into the others:
 c_i = e_i - sum_d B_id e_d,  B = Z_ind Z_dep^-1,  Z (k, m) the null space.
The remaining k - m *base parameters* are the fewest that describe the records completely. Source:
Gautier, Numerical calculation of the base inertial parameters of robots (1991).

Columns are scaled to unit norm throughout, so that one threshold suits kg m^2 and kg m. A direction
that consists mostly of sensor noise counts as null (`analysis.regression.noise`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr

from analysis.regression.least_squares import factored
from analysis.regression.settings import REGRESSION

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Combination:
    """A base parameter: parts (name, coefficient), of which the first has coefficient 1."""

    parts: tuple[tuple[str, float], ...]

    @property
    def text(self) -> str:
        """The combination as text: "R11 + R22 + 1.56 R12"."""
        words: list[str] = []
        for name, coefficient in self.parts:
            size = abs(coefficient)
            whole = round(size)
            figure = (
                f"{whole}"
                if whole and abs(size - whole) < REGRESSION.rounding_share
                else f"{size:.3g}"
            )
            sign = ("+ " if coefficient > 0 else "- ") if words else ""
            words.append(sign + (name if figure == "1" else f"{figure} {name}"))
        return " ".join(words)


@dataclass(frozen=True)
class Determinacy:
    """What rows determine of `names`: rank, condition number of the unit columns, base parameters.

    `null` (m, k) are the undetermined directions, `lost` the parameters in them; `base` the
    identifiable combinations of those, `known` the parameters that are identified individually.
    """

    names: tuple[str, ...]
    rank: int
    condition: float
    null: Array
    known: tuple[str, ...]
    lost: tuple[str, ...]
    base: tuple[Combination, ...]

    @property
    def complete(self) -> bool:
        """Whether every parameter is determined."""
        return self.rank == len(self.names)


def determined(names: Sequence[str], X: Array, noise: Array | None = None) -> Determinacy:
    """Return what rows X (m, k), or their triangle, determine of the k parameters `names`.

    `noise` (k, k) is the part of X'X that sensor noise makes.
    """
    k = len(names)
    factors = factored(X)
    scale, strong = factors.scale, factors.strong
    noisy = _noisy(factors.Vt[strong], factors.sigma[strong], scale, noise)
    null = np.vstack((factors.null, noisy))
    if len(null):
        null = np.linalg.qr(null.T)[0].T
    members = np.linalg.norm(null, axis=0) > REGRESSION.null_share
    lost = tuple(n for n, inside in zip(names, members, strict=True) if inside)
    known = tuple(n for n in names if n not in lost)
    base = _combinations(names, null, scale, np.any(X != 0.0, axis=0)) if len(null) else ()
    return Determinacy(
        tuple(names), k - len(null), factors.condition, null / scale, known, lost,
        tuple(c for c in base if any(name in lost for name, _ in c.parts)),
    )  # fmt: skip


def _noisy(Vt: Array, sigma: Array, scale: Array, noise: Array | None) -> Array:
    """Return the directions (scaled) whose information is mostly noise."""
    if noise is None or not len(sigma):
        return np.zeros((0, len(scale)))
    white = Vt / sigma[:, None]
    share, turn = np.linalg.eigh(white @ (noise / np.outer(scale, scale)) @ white.T)
    projected = (turn.T @ white)[share > REGRESSION.noise_share]
    return np.asarray(
        projected / np.maximum(np.linalg.norm(projected, axis=1, keepdims=True), 1e-300)
    )


def _combinations(
    names: Sequence[str], null: Array, scale: Array, shown: NDArray[np.bool_]
) -> list[Combination]:
    """Return the base parameters of a scaled null space (m, k), in the names' order."""
    m = len(null)
    order = qr(null, mode="r", pivoting=True)[1]
    dependent = np.sort(order[:m])
    independent = np.setdiff1d(np.arange(len(names)), dependent)
    back = np.linalg.inv(null[:, dependent])
    out = []
    for i in independent:
        c = np.zeros(len(names))
        c[i], c[dependent] = 1.0, -(back @ null[:, i])
        # The parameter of a column of zeros is undetermined by itself, and in no combination.
        c[(np.abs(c) < REGRESSION.negligible_share * np.abs(c).max()) | ~shown] = 0.0
        parts = [int(p) for p in np.flatnonzero(c)]
        plain = c * scale
        if parts:
            first = plain[parts[0]]
            out.append(Combination(tuple((names[int(p)], float(plain[p] / first)) for p in parts)))
    return out
