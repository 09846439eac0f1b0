"""Invariance: a cause has the same size everywhere; a look-alike has another in every corner.

An effect's sizes are solved again on parts of the rows: each step, each half of the records, each
direction of motion, fast and slow, its form as it was found. A contribution that moves by more than
noise, than what a catalogue's simpler form may cause, and than what a larger effect's form may
spill onto it, is none.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from analysis.effects.base import Effect, shapes_of
from analysis.terms.base import Used
from analysis.trace.data.noise_floor import STATED
from analysis.trace.data.regression_data import RegressionData
from analysis.trace.judge.inference import blocks, others
from analysis.trace.search.linear_fit import FORM, orthonormal
from analysis.trace.search.refinement import ExactFit, jacobian, table

Array = NDArray[np.float64]

TOLERANCE = 0.2  # relative disagreement that a catalogue's simpler form may cause
DEVIATIONS = 3.5
TELLS = 0.05  # of a column's energy off the others': a subset with less says nothing of a size
POWER = 0.25  # a subset judges a size that it knows this well, relative
HIDDEN = 0.1  # of a contribution must stand out of the model's own columns


def subsets(train_data: RegressionData, joint: int | None) -> dict[str, Array]:
    """Return masks (M,) of rows: each step, each half of the records, each direction of motion."""
    M = train_data.base.shape[0]
    out: dict[str, Array] = {}
    index = {conditioned.group: k for k, conditioned in enumerate(train_data.records)}
    early, ahead = np.zeros(M, dtype=bool), np.zeros(M, dtype=bool)
    outer = np.zeros(M, dtype=bool)
    for s in train_data.segments:
        name = f"step {s.group[1]}"
        out.setdefault(name, np.zeros(M, dtype=bool))[s.where] = True
        conditioned = train_data.records[index[s.group]]
        time = train_data.rows[index[s.group]][s.equation].time
        early[s.where] = time < 0.5 * (time[0] + time[-1])
        own = joint if joint is not None else int(s.equation.rsplit("_", 1)[1]) - 1
        at = np.clip(
            np.rint(time * conditioned.record.sample_rate).astype(int),
            0,
            len(conditioned.signals.t) - 1,
        )
        ahead[s.where] = conditioned.signals.sd[at, own] > 0
        size = np.abs(conditioned.signals.sd[at, own])
        outer[s.where] = size > np.median(size)
    out |= {
        "first half": early, "second half": ~early, "extending": ahead, "retracting": ~ahead,
        "fast": outer, "slow": ~outer,
    }  # fmt: skip
    return out


def _unmeasured(train_data: RegressionData) -> NDArray[np.int64] | None:
    """Return the block of every row (M,) where some floor is the stated noise alone, else None.

    Then nobody has measured the noise, and what is left has to stand for it, block by block.
    """
    if all(floor.source != STATED for floor in train_data.floors):
        return None
    numbers = blocks(train_data)
    for k, s in enumerate(train_data.segments):
        numbers[s.where] += (int(numbers.max()) + 1) * k
    return numbers


def _clustered(basis: Array, residual: Array, clusters: NDArray[np.int64]) -> float:
    """Return the root of the sum over blocks of (column . residual)^2, largest of the columns."""
    _, index = np.unique(clusters, return_inverse=True)
    sums = [np.bincount(index, weights=column * residual) for column in basis.T]
    return max((float(np.linalg.norm(s)) for s in sums), default=0.0)


def _larger(model: ExactFit, train_data: RegressionData, used: Used, mask: Array) -> float:
    """Return the energy that the largest other effect has on a subset, 0 if none is larger.

    What its catalogue form misses of it (`FORM`) spills onto a smaller effect's coefficient.
    """
    rows = table(train_data, model.terms)
    energy = {}
    for u in model.terms:
        if isinstance(u.term, Effect):
            own = [rows.names.index(c.parameter) for c in u.term.coefficients(train_data.rig)]
            values = np.array([model.beta.get(rows.names[k], 0.0) for k in own])
            part = rows.matrix[mask][:, own] @ values
            energy[u.term.name, u.term.where] = float(part @ part)
    mine = energy.pop((used.term.name, used.term.where), 0.0)
    most = max(energy.values(), default=0.0)
    return most if most > mine else 0.0


def _contribution(train_data: RegressionData, model: ExactFit, used: Used) -> Array:
    """Return what an effect adds to the model's side of the rows (M,), whitened."""
    rig = train_data.rig
    neutral = tuple(
        value if s.neutral is None else s.neutral
        for s, value in zip(shapes_of(rig, used), used.shape, strict=True)
    )
    terms = tuple(Used(u.term, neutral) if u is used else u for u in model.terms)
    shared = {c.parameter for u in model.terms if u is not used for c in u.term.coefficients(rig)}
    own = {c.parameter for c in used.term.coefficients(rig)} - shared
    beta = {**model.beta, **dict.fromkeys(own, 0.0)}
    return np.asarray(table(train_data, terms).residual(beta) - model.residual)


def invariance(
    train_data: RegressionData, model: ExactFit, used: Used, joint: int | None
) -> list[tuple[str, float]]:
    """Return where an effect is not of the size it has over all rows: (subset, size there over it).

    What the effect's sizes, all together, would change in its contribution to a subset's rows is
    held against that contribution: two numbers that only their product decides are judged by it.
    """
    names, J = jacobian(train_data, model, used)
    base = others(train_data, model, names)
    # A shape such as the presliding distance is the form's, not the effect's size.
    sizes = {c.parameter for c in used.term.coefficients(train_data.rig)}
    sizes |= {s.parameter for s in shapes_of(train_data.rig, used) if s.neutral is not None}
    own = J[:, [k for k, name in enumerate(names) if name in sizes]]
    contribution = _contribution(train_data, model, used)
    whole = float(np.linalg.norm(_off(base, contribution)))
    clusters = _unmeasured(train_data)
    out = []
    for label, mask in subsets(train_data, joint).items():
        B = orthonormal(base[mask])
        here = _off(B, contribution[mask])
        size = float(np.linalg.norm(here))
        # What hardly acts there, or not beside the model's own parameters, tells of no size.
        if size < max(HIDDEN * np.linalg.norm(contribution[mask]), np.sqrt(TELLS) * whole):
            continue
        Q = orthonormal(_off(B, own[mask]))
        left = _off(B, model.residual[mask])
        change = Q @ (Q.T @ left)
        error = 1.0
        if clusters is not None:
            error = max(error, _clustered(Q, left - change, clusters[mask]))
        if error > POWER * size:
            continue
        spill = np.sqrt(FORM * _larger(model, train_data, used, mask))
        allowed = spill + float(np.hypot(DEVIATIONS * error, TOLERANCE * size))
        if float(np.linalg.norm(change)) > allowed:
            out.append((label, 1.0 + float(here @ change) / size**2))
    return out


def _off(basis: Array, columns: Array) -> Array:
    """Return columns without their part in the span of an orthonormal basis."""
    return np.asarray(columns - basis @ (basis.T @ columns))
