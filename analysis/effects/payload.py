"""A mass at the tip of the last link."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.constants import g as standard_gravity

from analysis.effects.base import Array, Effect, beyond
from analysis.effects.mechanics import torque_limit
from analysis.signals.conditioning import Signals
from analysis.terms.base import (
    CONTRIBUTE,
    QD,
    THETA,
    TORQUE,
    Coefficient,
    Columns,
    kernel,
)
from analysis.terms.gravity import Gravity
from analysis.terms.inertia import Inertia, inertia_map
from analysis.terms.sine_cosine import sine_cosine
from rig.model.parameters import inertia_names
from rig.model.rig import Rig


@kernel
def _payload(phase, bench, x, z, par, out, M, dz):  # type: ignore[no-untyped-def]
    # The tip's Jacobian to joint i is the sum of l_k (cos, sin)(theta_k) over links k >= i; its
    # acceleration at rest of the joints is the sum of l_k theta_k'^2 (-sin, cos)(theta_k).
    if phase != CONTRIBUTE:
        return
    N = x.shape[1]
    m, g = par[0], par[1]
    ax, ay, rate = 0.0, 0.0, 0.0
    for k in range(N):
        rate += x[QD, k]
        sine, cosine = sine_cosine(x[THETA, k])
        ax -= par[2 + k] * rate * rate * sine
        ay += par[2 + k] * rate * rate * cosine
    jx_i, jy_i = 0.0, 0.0
    for i in range(N - 1, -1, -1):
        sine, cosine = sine_cosine(x[THETA, i])
        jx_i += par[2 + i] * cosine
        jy_i += par[2 + i] * sine
        # theta = 0 hangs straight down: the tip's height grows by jy per unit of angle.
        out[TORQUE, i] -= m * (jx_i * ax + jy_i * (ay + g))
        jx_j, jy_j = 0.0, 0.0
        for j in range(N - 1, -1, -1):
            sine, cosine = sine_cosine(x[THETA, j])
            jx_j += par[2 + j] * cosine
            jy_j += par[2 + j] * sine
            M[i, j] += m * (jx_i * jx_j + jy_i * jy_j)


@dataclass(frozen=True)
class Payload(Effect):
    """A point mass m at the tip: R_ij grows by m l_i l_j, W_i by m l_i.

    Its columns are a sum of the baseline's own, so M, R and W of records that all carry it absorb
    it COMPLETELY: no excitation of them shows it. It is found only against a reference: records
    that are known to be without it (`Signals.loaded`), where it has no columns, or a model
    identified without it, whose M, R and W are held.
    """

    mechanism = "gravity"
    element = "load"
    name = "payload"
    exact = True
    family = "mechanics"
    variable = "gravity and inertia alike"
    quantity = "absolute angle"
    confounders = ()
    separated_by = (
        "records with and without the payload, or a model identified without it as reference"
    )
    kernel = _payload

    @classmethod
    def all_places(cls, rig: Rig) -> tuple[str, ...]:
        """Return the bench, where it has links."""
        return () if getattr(rig, "prismatic", False) else ("bench",)

    def absorbed(self, rig: Rig) -> str:
        """Return that the baseline's M, R and W absorb it."""
        return (
            "M, R and W of records that all carry the same payload absorb it completely; compare "
            "with records without it"
        )

    def coefficients(self, rig: Rig) -> tuple[Coefficient, ...]:
        """Return m [kg]."""
        return (Coefficient("m_payload", "kg", "mechanical"),)

    def columns(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Columns:
        """Return the sum of inertia's and gravity's columns, weighted by `growth`; bare: none."""
        if signals.loaded is False:
            return {}
        weights = growth(rig)
        out: Columns = {}
        for term in (Inertia(), Gravity()):
            for row, columns in term.columns(rig, signals, ()).items():
                total = sum(weights[p] * column for p, column in columns.items())
                here = out.setdefault(row, {"m_payload": np.zeros(len(signals.t))})
                here["m_payload"] = here["m_payload"] + total
        return out

    def pack(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> Array:
        """Return m, g and the links' lengths."""
        return np.array([values["m_payload"], rig.gravity, *(j.link_length for j in rig.joints)])

    def problem(self, rig: Rig, values: Mapping[str, float], shape: Sequence[float]) -> str:
        """Reject a negative mass, and one that no joint can lift."""
        return beyond("m_payload", values["m_payload"], "kg", heaviest_payload(rig))


def heaviest_payload(rig: Rig) -> float:
    """Return the largest mass [kg] that a joint can lift at its link's end, in mid-stroke."""
    # The limit is half of a joint's largest torque.
    lifted = (2.0 * torque_limit(rig, i) / j.link_length for i, j in enumerate(rig.joints))
    return float(max(lifted) / standard_gravity)


def growth(rig: Rig) -> dict[str, float]:
    """Return the increase of each mechanical parameter per kilogram at the tip."""
    lengths = np.array([j.link_length for j in rig.joints])
    names = inertia_names(len(lengths))
    # Of R = sum_k p_k E_k the coefficients are found by least squares on the disjoint patterns E.
    patterns = inertia_map(len(lengths)).reshape(len(names), -1)
    shares = np.linalg.lstsq(patterns.T, np.outer(lengths, lengths).ravel(), rcond=None)[0]
    weights = {f"W{i}": float(length) for i, length in enumerate(lengths, start=1)}
    return dict(zip(names, map(float, shares), strict=True)) | weights


TERMS = (Payload,)
