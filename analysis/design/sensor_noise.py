"""Propagation of sensor noise, to first order, from the converters to the normal equations.

The residual of one equation is e(t) = y - X beta, built point by point from filtered channels,
then low-passed and decimated as a whole row. White noise n_c of channel c (its stated noise and
the rounding of its converter, step^2 / 12) enters through every derivative k that is taken of it:

    e = D H_rows sum_c sum_k diag(S_ck) H_k n_c,        S_ck(t) = d e(t) / d (channel c's k-th).

The scores g = X'e of all equations of a record therefore have the covariance
    cov g = sum_c sigma_c^2 B_c B_c',   B_c = sum_eq X' D H_rows sum_k diag(S_ck) H_k,
and B_c is computed by applying the transposed filters to the columns of X. Nothing is drawn at
random; noise shared between equations and the correlation that the filters cause between rows are
included. Source: linear error propagation.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from analysis.design.settings import DESIGN
from analysis.regression.noise import sensor_variance
from analysis.regression.rows import Array, Filtering, Rows, prepared, right_sides
from analysis.signals.conditioning import Signals
from analysis.signals.convolution import same_convolved
from analysis.signals.filters import FirSmoother
from analysis.terms.base import Used, family_of
from rig.model import channels as ch
from rig.model.parse import InputError
from rig.model.rig import Rig


@dataclass(frozen=True)
class Input:
    """One filtered signal of the equations: a derivative of one channel.

    `field` is its name among the signals, `joint` 0-based or None for the bench.
    """

    channel: str
    order: int
    field: str
    joint: int | None


def inputs_of(rig: Rig) -> tuple[Input, ...]:
    """Return the inputs of the rows, the pistons of all joints among them.

    A real end stop yields a little, by an amount that no rig file states. Where it is visible, the
    analysis includes that piston's noise in the rows; so does the prediction.
    """
    inputs = []
    for i in range(len(rig.joints)):
        for kind, fields in (
            (ch.PISTON, ("s", "sd", "sdd")),
            (ch.SPOOL, ("u",)),
            (ch.CAP, ("p_cap", "pd_cap")),
            (ch.ROD, ("p_rod", "pd_rod")),
        ):
            inputs += [Input(ch.channel(kind, i + 1), k, f, i) for k, f in enumerate(fields)]
    inputs.append(Input(ch.SUPPLY, 0, "p_s", None))
    inputs.append(Input(ch.TEMPERATURE, 0, "temperature", None))
    return tuple(i for i in inputs if i.channel in rig.channels)


def shifted(rig: Rig, signals: Signals, derivative: Input, by: float) -> Signals:
    """Return the signals with one input shifted by `by` at every instant (n,)."""
    if derivative.joint is None:
        return replace(signals, **{derivative.field: getattr(signals, derivative.field) + by})
    i = derivative.joint
    if derivative.field not in ("s", "sd", "sdd"):
        changed = getattr(signals, derivative.field).copy()
        changed[:, i] += by
        return replace(signals, **{derivative.field: changed})
    s, sd = signals.s.copy(), signals.sd.copy()
    # The second derivative of the piston is not kept; it follows from the joint's.
    slope = rig.joints[i].linkage.jacobian_rate(signals.q[:, i])
    sdd = signals.G[:, i] * signals.qdd[:, i] + slope * signals.qd[:, i] ** 2
    s[:, i] += by if derivative.field == "s" else 0.0
    sd[:, i] += by if derivative.field == "sd" else 0.0
    sdd = sdd + (by if derivative.field == "sdd" else 0.0)
    q, qd, qdd, G = (a.copy() for a in (signals.q, signals.qd, signals.qdd, signals.G))
    q[:, i], G[:, i], new_slope = rig.joints[i].geometry(s[:, i])
    qd[:, i] = sd[:, i] / G[:, i]
    qdd[:, i] = (sdd - new_slope * qd[:, i] ** 2) / G[:, i]
    V_cap, V_rod = signals.V_cap.copy(), signals.V_rod.copy()
    V_cap[:, i], V_rod[:, i] = rig.chamber_volumes(i, s[:, i])
    return replace(
        signals, s=s, sd=sd, q=q, qd=qd, qdd=qdd, G=G, theta=np.cumsum(q, axis=1),
        V_cap=V_cap, V_rod=V_rod,
    )  # fmt: skip


def residuals(
    rig: Rig, terms: Sequence[Used], signals: Signals, beta: Mapping[str, float]
) -> dict[str, Array]:
    """Return y - X beta (n,) of every equation, before the rows' filter."""
    signals = prepared(rig, terms, signals)
    out = right_sides(rig, signals)
    for used in terms:
        for name, columns in used.term.columns(rig, signals, used.shape).items():
            for parameter, column in columns.items():
                out[name] = out[name] - beta[parameter] * column
    return out


def score_covariance(
    rig: Rig,
    terms: Sequence[Used],
    signals: Signals,
    filtering: Filtering,
    rows: Mapping[str, Rows],
    beta: Mapping[str, float],
) -> dict[str, Array]:
    """Return cov g (k, k) of each family's scores for one record, from its noise-free signals.

    `rows` are the record's own, `beta` the rows' coefficients (1/b, not b). Raises InputError for
    filters that are no finite convolutions.
    """
    channels = filtering.channels
    if not isinstance(channels, FirSmoother):
        raise InputError(f"noise cannot be propagated through the filter {channels.name!r}")
    n = len(signals.t)
    weights_of = {name: _sample_weights(r, filtering, n, signals.rate) for name, r in rows.items()}
    out = {family_of(name): np.zeros((len(r.names), len(r.names))) for name, r in rows.items()}
    by_channel: dict[str, list[Input]] = {}
    for derivative in inputs_of(rig):
        by_channel.setdefault(derivative.channel, []).append(derivative)
    for channel, derivatives in by_channel.items():
        variance = sensor_variance(rig.sensors.of(ch.kind_of(channel)[0]))
        influence: dict[str, Array] = {}
        for derivative in derivatives:
            taps = channels.taps[derivative.order]
            step = DESIGN.noise_step * float(np.sqrt(variance) * np.linalg.norm(taps))
            high = residuals(rig, terms, shifted(rig, signals, derivative, step), beta)
            low = residuals(rig, terms, shifted(rig, signals, derivative, -step), beta)
            for name, weights in weights_of.items():
                slope = (high[name] - low[name]) / (2.0 * step)
                if slope.any():
                    family = family_of(name)
                    part = _transposed(slope[:, None] * weights, taps)
                    influence[family] = influence[family] + part if family in influence else part
        for family, B in influence.items():
            out[family] += variance * (B.T @ B)
    return out


def _sample_weights(rows: Rows, filtering: Filtering, n: int, rate: float) -> Array:
    """Return (D H_rows)' X (n, k): the weight of each instant's residual in the scores."""
    places = np.rint(rows.time * rate).astype(int)
    upsampled = np.zeros((n, rows.matrix.shape[1]))
    upsampled[places] = rows.matrix
    return upsampled if filtering.rows is None else _transposed(upsampled, filtering.rows.taps[0])


def _transposed(weights: Array, taps: Array) -> Array:
    """Return H'w of the filter y = taps * x: convolution with the reversed taps, (n, k)."""
    filled = np.flatnonzero(weights.any(axis=0))
    out = np.zeros_like(weights)
    if len(filled):
        out[:, filled] = same_convolved(weights[:, filled], taps[::-1])
    return out
