"""Find parameter combinations that the records determine, and steps that would determine the rest.

A step is judged by geometry alone: in a candidate one joint moves within its stroke, the joints
beyond it stand at an end stop or at mid-stroke. Its torque rows are multiplied by the null
directions of the records; it determines a null direction whose product is not small.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from analysis.identify.checks import Check
from analysis.identify.settings import IDENTIFY
from analysis.regression.identifiability import Determinacy, determined, predicted_rows
from analysis.regression.solve import Solution
from rig.model.parameters import gain_names, parameter_names
from rig.model.rig import Rig

Array = NDArray[np.float64]


def base_statements(rig: Rig, solutions: Mapping[str, Solution]) -> list[Check]:
    """State, for each family with undetermined parameters, what is determined and what to add."""
    out = []
    for family, solution in solutions.items():
        if not solution.unidentifiable:
            continue
        k = len(solution.names)
        noise = solution.noise[:k, :k] if len(solution.noise) else None
        base = determined(solution.names, solution.triangle[:k, :k], noise)
        combined = ", ".join(part.text for part in base.base) or "no combination of them"
        steps = ", and: ".join(_suggested_steps(rig, family, base))
        add = f"Add: {steps}" if steps else "Add a richer excitation: other poses, other speeds"
        out.append(
            Check(
                f"base parameters {family}", False,
                f"rank {base.rank} of {k}; of {' '.join(solution.unidentifiable)} these records "
                f"determine: {combined}. {add}",
            )
        )  # fmt: skip
    return out


def _suggested_steps(rig: Rig, family: str, lacking: Determinacy) -> list[str]:
    # No steps are planned for electric rigs, whose motion has no known stroke. What an effect's own
    # parameters need is in its catalogue entry.
    known = parameter_names(len(rig.joints))
    if rig.electric or any(name not in known for name in lacking.names):
        return []
    return mechanical_help(rig, lacking) if family == "mechanical" else fluid_help(rig, lacking)


def fluid_help(rig: Rig, lacking: Determinacy) -> list[str]:
    """Return the steps, in words, that would determine the flow gains and the bulk modulus."""
    suggestions = []
    for joint in range(1, len(rig.joints) + 1):
        if set(gain_names(joint)) & set(lacking.undetermined):
            suggestions.append(f"excite joint {joint} in both directions")
    if not suggestions and "b" in lacking.undetermined:
        suggestions.append("excite any joint faster, with a multisine to 5 Hz and above")
    return suggestions


def mechanical_help(rig: Rig, lacking: Determinacy) -> list[str]:
    """Return, in words, the fewest steps found that determine every null direction."""
    undetermined = lacking.null
    steps = list(_candidates(rig))
    rows = [_rows(rig, excited, positions) for excited, positions in steps]
    scale = np.maximum(np.linalg.norm(np.vstack(rows), axis=0), 1e-300)
    # Each candidate is scaled by its own size: an outer joint's small torques determine as much.
    rows = [X / np.linalg.norm(X / scale, 2) for X in rows]
    suggestions = []
    while len(undetermined):
        basis = np.linalg.qr((undetermined * scale).T)[0]
        svds = [np.linalg.svd(X / scale @ basis, full_matrices=True) for X in rows]
        ranks = [int(np.sum(sigma > IDENTIFY.visible_direction)) for _, sigma, _ in svds]
        # Prefer most directions, then the clearest; a joint behind a closed valve yields under
        # load, one at an end stop does not.
        clarity = [
            float(np.sum(sigma)) * 0.9 ** steps[i][1].count(0.0)
            for i, (_, sigma, _) in enumerate(svds)
        ]
        best = max(range(len(rows)), key=lambda i: (ranks[i], clarity[i]))
        if not ranks[best]:
            break
        suggestions.append(_motion_text(*steps[best]))
        undetermined = (basis @ svds[best][2][ranks[best] :].T).T / scale
    return suggestions


def _candidates(rig: Rig) -> Iterator[tuple[int, tuple[float, ...]]]:
    """Yield (excited joint, 0-based; piston positions of the joints beyond it [half strokes])."""
    N = len(rig.joints)
    for excited in range(N - 1, -1, -1):
        beyond = itertools.product((-1.0, 1.0, 0.0), repeat=N - 1 - excited)
        for positions in itertools.islice(beyond, IDENTIFY.most_poses):
            yield excited, positions


def _rows(rig: Rig, excited: int, positions: tuple[float, ...]) -> Array:
    """Return the triangle of the torque rows of a prescribed motion of the joint `excited`."""
    N, n = len(rig.joints), round(IDENTIFY.advice_seconds * rig.sample_rate)
    t = np.arange(n) / rig.sample_rate
    piston = np.zeros((n, N))
    for joint, position in enumerate(positions, start=excited + 1):
        piston[:, joint] = 0.5 * position * rig.joints[joint].cylinder.stroke
    wave = sum(
        share * np.sin(2 * np.pi * hertz * t + hertz) for hertz, share in IDENTIFY.advice_lines
    )
    piston[:, excited] = (
        IDENTIFY.advice_stroke * rig.joints[excited].cylinder.stroke * np.asarray(wave)
    )
    level = np.full((n, N), 0.5 * rig.supply.pressure)
    channels = {"piston": piston, "spool": np.zeros((n, N)), "cap_pressure": level,
             "rod_pressure": level}  # fmt: skip
    locked = [i + 1 for i in range(N) if i != excited]
    return predicted_rows(rig, channels, locked)["mechanical"]


def _motion_text(excited: int, positions: tuple[float, ...]) -> str:
    at = {-1.0: "at end_min", 1.0: "at end_max", 0.0: "closed at 0 mm"}
    held = [f"joint {i + 1} closed at 0 mm" for i in range(excited)]
    held += [f"joint {i} {at[p]}" for i, p in enumerate(positions, start=excited + 2)]
    return f"excite joint {excited + 1}" + (f" with {', '.join(held)}" if held else "")
