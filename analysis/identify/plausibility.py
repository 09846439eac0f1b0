"""Statements about identified parameters: whether a machine can have them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from analysis.identify.checks import Check
from analysis.simulation.model import Estimate
from analysis.terms.inertia import chain_matrix, mass_matrix
from rig.model.parameters import gain_names, inertia_names
from rig.model.rig import Rig

Array = NDArray[np.float64]

BULK_RANGE = (5e7, 2.5e9)  # [Pa] hoses with air .. pure mineral oil with margin
LENGTH_TOLERANCE = 0.05  # relative, of R12/W2 against l1


def consistency(rig: Rig, estimates: Mapping[str, Estimate]) -> list[Check]:
    """State signs, positive inertia over the workspace, R12/W2 against l1, and b."""
    return [_signs(rig, estimates), *_inertia(rig, estimates), *_bulk(estimates)]


def _signs(rig: Rig, estimates: Mapping[str, Estimate]) -> Check:
    joints = range(1, len(rig.joints) + 1)
    positive = [f"Fv{i}" for i in joints] + ["b"]
    positive += [name for i in joints for name in gain_names(i)]
    bad = [
        f"{name} = {estimates[name].value:.4g}"
        for name in positive
        if name in estimates and estimates[name].value <= 0
    ]
    judged = (
        "friction, bulk modulus and flow gains are" if "fluid" in rig.families else "friction is"
    )
    return Check("signs", not bad, "; ".join(bad) or f"{judged} positive")


def _inertia(rig: Rig, estimates: Mapping[str, Estimate]) -> list[Check]:
    N = len(rig.joints)
    names = inertia_names(N)
    values = {name: estimates[name].value for name in names if name in estimates}
    if len(values) < len(names) or not np.isfinite(list(values.values())).all():
        return [Check("inertia", False, "cannot be judged: not every inertia is identified")]
    R = chain_matrix(values, N)
    smallest, where = min(
        ((float(np.linalg.eigvalsh(mass_matrix(R, q))[0]), q) for q in workspace(rig)),
        key=lambda pair: pair[0],
    )
    turns = rig.unit_of_parameter(names[0]) != "kg"
    angles = " ".join(f"{np.degrees(v):.0f} deg" if turns else f"{v:.3g} m" for v in where)
    out = [
        Check(
            "inertia",
            smallest > 0,
            f"smallest eigenvalue of M over the workspace {smallest:.4g} "
            f"{rig.unit_of_parameter(names[0])}, at q = {angles}",
        )
    ]
    for i in range(N):
        for j in range(i + 1, N):
            W = estimates[f"W{j + 1}"].value if f"W{j + 1}" in estimates else np.nan
            if np.isfinite(W) and W != 0:
                length, ratio = rig.joints[i].link_length, R[i, j] / W
                if not length:
                    continue
                off = ratio / length - 1
                out.append(
                    Check(
                        "link length",
                        bool(abs(off) < LENGTH_TOLERANCE),
                        f"R{i + 1}{j + 1}/W{j + 1} = {ratio:.4g} m against link {i + 1} of "
                        f"{length:g} m ({100 * off:+.1f} %); rigid bodies give equality",
                    )
                )
    return out


def _bulk(estimates: Mapping[str, Estimate]) -> list[Check]:
    b = estimates["b"].value if "b" in estimates else np.nan
    if not np.isfinite(b):
        return []
    low, high = BULK_RANGE
    detail = f"b = {b / 1e6:.4g} MPa; plausible {low / 1e6:g} to {high / 1e6:g} MPa"
    return [Check("bulk modulus", low < b < high, detail)]


def workspace(rig: Rig, points: int = 9) -> list[Array]:
    """Return joint angles (N,) spread over the stroke: a grid, or a fixed lattice."""
    N = len(rig.joints)
    if points**N <= 4096:
        axes = np.meshgrid(*([np.linspace(0, 1, points)] * N), indexing="ij")
        unit = np.column_stack([axis.ravel() for axis in axes])
    else:
        # Additive recurrence with square roots of primes fills the cube evenly.
        steps = np.sqrt([2, 3, 5, 7, 11, 13, 17, 19, 23][:N])
        unit = np.outer(np.arange(4096), steps) % 1.0
    angles = np.empty_like(unit)
    for i, joint in enumerate(rig.joints):
        low, high = joint.position_range
        angles[:, i] = joint.geometry(low + unit[:, i] * (high - low))[0]
    return list(angles)
