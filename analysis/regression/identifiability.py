"""Identifiability: what rows determine, and what a planned experiment would determine.

Rows [X] determine c'p exactly where c is orthogonal to the null space of X. With m null directions
m parameters are chosen to be *dependent* (columns that pivoted QR of the null space finds best
conditioned) and are regrouped into the others:
 c_i = e_i - sum_d B_id e_d,  B = Z_ind Z_dep^-1,  Z (k, m) the null space.
The remaining k - m *base parameters* are the fewest that describe the records completely. Source:
Gautier, Numerical calculation of the base inertial parameters of robots (1991).

Columns are scaled to unit norm throughout, so that one threshold suits kg m^2 and kg m. A direction
that consists mostly of sensor noise counts as null (`analysis.regression.noise`).

A planned step's motion on the twin results in the same rows as its record
(`analysis.regression.rows`), without sensor noise: rank and condition number of all steps' rows
stacked state what can be identified. The row filter is omitted: there is no noise to remove, and it
does not change the rank.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr

from analysis.regression.least_squares import factored
from analysis.regression.rows import Array, Filtering, parameters_of, record_rows
from analysis.regression.settings import REGRESSION
from analysis.regression.solve import square
from analysis.signals.conditioning import condition
from analysis.signals.filters import channel_filter
from analysis.terms import baseline_of
from analysis.terms.base import FAMILIES, Used, family_of
from rig.model import channels as ch
from rig.model.records import Record
from rig.model.rig import Rig

Triangles = Mapping[str, Array]  # family -> triangle (k, k) of its rows


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
            rounded = round(size)
            figure = (
                f"{rounded}"
                if rounded and abs(size - rounded) < REGRESSION.rounding_share
                else f"{size:.3g}"
            )
            sign = ("+ " if coefficient > 0 else "- ") if words else ""
            words.append(sign + (name if figure == "1" else f"{figure} {name}"))
        return " ".join(words)


@dataclass(frozen=True)
class Determinacy:
    """What rows determine of `names`: rank, condition number of the unit columns, base parameters.

    `null` (m, k) are the undetermined directions, `undetermined` the parameters in them, `base` the
    identifiable combinations of these; `identified` are the parameters identified individually.
    """

    names: tuple[str, ...]
    rank: int
    condition: float
    null: Array
    identified: tuple[str, ...]
    undetermined: tuple[str, ...]
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
    scale, mask = factors.scale, factors.determined
    noisy = _noise_directions(factors.Vt[mask], factors.sigma[mask], scale, noise)
    null = np.vstack((factors.null, noisy))
    if len(null):
        null = np.linalg.qr(null.T)[0].T
    members = np.linalg.norm(null, axis=0) > REGRESSION.null_share
    undetermined = tuple(n for n, inside in zip(names, members, strict=True) if inside)
    identified = tuple(n for n in names if n not in undetermined)
    base = _combinations(names, null, scale, np.any(X != 0.0, axis=0)) if len(null) else ()
    return Determinacy(
        tuple(names), k - len(null), factors.condition, null / scale, identified, undetermined,
        tuple(c for c in base if any(name in undetermined for name, _ in c.parts)),
    )  # fmt: skip


def _noise_directions(Vt: Array, sigma: Array, scale: Array, noise: Array | None) -> Array:
    """Return the scaled directions (l, k) whose information is mostly sensor noise."""
    if noise is None or not len(sigma):
        return np.zeros((0, len(scale)))
    white = Vt / sigma[:, None]
    shares, vectors = np.linalg.eigh(white @ (noise / np.outer(scale, scale)) @ white.T)
    projected = (vectors.T @ white)[shares > REGRESSION.noise_share]
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
    inverse = np.linalg.inv(null[:, dependent])
    out = []
    for i in independent:
        c = np.zeros(len(names))
        c[i], c[dependent] = 1.0, -(inverse @ null[:, i])
        # The parameter of a column of zeros is undetermined by itself, and in no combination.
        c[(np.abs(c) < REGRESSION.negligible_share * np.abs(c).max()) | ~shown] = 0.0
        parts = [int(p) for p in np.flatnonzero(c)]
        c *= scale
        if parts:
            lead = c[parts[0]]
            out.append(Combination(tuple((names[int(p)], float(c[p] / lead)) for p in parts)))
    return out


def twin_channels(rig: Rig, names: Sequence[str], motion: Mapping[str, Array]) -> dict[str, Array]:
    """Return the channels `names`, each (n,), of a motion on the twin; supply and oil constant."""
    channels: dict[str, Array] = {}
    for name in names:
        kind, joint = ch.kind_of(name)
        if joint is not None:
            channels[name] = motion[kind][:, joint - 1]
        else:
            steady = rig.supply.pressure if kind == ch.SUPPLY else rig.oil.temperature
            channels[name] = np.full(len(motion["piston"]), steady)
    return channels


def predicted_rows(
    rig: Rig, motion: Mapping[str, Array], locked: Sequence[int]
) -> dict[str, Array]:
    """Return the triangle (k, k) of each family's rows of a motion on the twin.

    `motion` is what `analysis.simulation.twin.simulate_commands` returns or a part of it, arrays
    (n, N); `locked` the joints (1-based) that were held.
    """
    used = tuple(Used(term) for term in baseline_of(rig))
    ideal = rig.model_copy(update={"sensors": rig.sensors.model_copy(update={"skew": 0.0})})
    channels = twin_channels(rig, rig.channels, motion)
    record = Record("twin", "twin", tuple(locked), 1, rig.sample_rate, channels)
    filters = Filtering(channel_filter(rig.sample_rate), None, REGRESSION.sample_step)
    bands = np.array([0.0 if i + 1 in locked else np.inf for i in range(len(rig.joints))])
    rows = record_rows(ideal, used, condition(ideal, record, filters.channels, bands), filters)
    stacked: dict[str, list[Array]] = {}
    for name, part in rows.items():
        stacked.setdefault(family_of(name), []).append(part.matrix)
    return {family: square(np.vstack(parts)) for family, parts in stacked.items()}


def judge(rig: Rig, steps: Sequence[Triangles]) -> dict[str, Determinacy]:
    """Return, by family, what the stacked rows of these steps determine."""
    used = tuple(Used(term) for term in baseline_of(rig))
    out = {}
    for family in FAMILIES:
        names = parameters_of(rig, used, family)
        X = np.vstack([step[family] for step in steps]) if steps else np.zeros((1, len(names)))
        out[family] = determined(names, X)
    return out
