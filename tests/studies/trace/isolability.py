"""Which pairs of effects an experiment can separate, from columns and noise alone.

With every effect a at its smallest size of interest, the whitened change of the rows that it makes
(noise 1 per row), and P_b the projection off the baseline's columns and those of another effect b,
 d(a | b) = min over b's shapes of ||P_b a||,
in standard deviations of the noise: what stays of a when b, at any size and any shape of its grid,
is fitted in its place. The diagonal has d(a) = ||P a||, without another effect. No answer of the
trace enters.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Final

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray

from analysis.effects.base import Effect
from analysis.report.plots.style import INK, figure, style, svg
from analysis.terms import baseline_of
from analysis.terms.base import Used
from analysis.trace.data.candidates import catalogue, variants
from analysis.trace.data.conditioned_record import conditioned_records
from analysis.trace.data.regression_data import (
    RegressionData,
    VariantColumns,
    evidence,
    regression_data,
    variant_columns,
)
from analysis.trace.next_experiment.discrimination import smallest_effect
from analysis.trace.search.linear_fit import orthonormal
from rig.model.records import Run
from tests.studies.pages import Picture, Section, Table

Array = NDArray[np.float64]

PROTOCOL: Final = "lock-and-excite-multisine"
SEEN: Final = 10.0  # standard deviations from which an effect is seen, or told from another


@dataclass(frozen=True)
class Isolability:
    """Distances (K, K) of K effects in standard deviations of the noise; row: what is there."""

    names: tuple[str, ...]
    distance: Array

    @property
    def inseparable(self) -> list[tuple[str, str, float, float]]:
        """Pairs of which either, seen alone, cannot be told from the other; the larger first."""
        out = []
        K = len(self.names)
        for a in range(K):
            for b in range(K):
                alone, beside = self.distance[a, a], self.distance[a, b]
                if a != b and alone >= SEEN > beside:
                    out.append((self.names[a], self.names[b], float(alone), float(beside)))
        return sorted(out, key=lambda row: row[3])


def shipped_run(seed: int) -> Run:
    """Return the records that the demonstration's protocol takes of a clean simulated bench."""
    from rig.runs.rigs import load_rig
    from tests.studies.direct_bench import simulated_run

    return simulated_run(load_rig("shinshu-2dof"), PROTOCOL, seed)[0]


def isolability(run: Run, joint: int = 2) -> Isolability:
    """Return the matrix of every named effect at one joint, at the bench or at its sensors."""
    rig = run.rig
    terms = tuple(map(Used, baseline_of(rig)))
    data = regression_data(rig, terms, conditioned_records(rig, [run]))
    here = [e for e in catalogue(rig) if e.where.startswith(("bench", f"joint {joint}"))]
    least = {e: found for e in here if (found := _least(data, e)) is not None}
    changes = {e: change for e, (change, _) in least.items()}
    grids: dict[Effect, list[Array]] = {e: [columns] for e, (_, columns) in least.items()}
    for entry in variant_columns(
        data, variants(rig, list(changes), evidence(data, data.mean_residual))
    ):
        if entry.used.term in grids:
            grids[entry.used.term].append(entry.columns)
    base = orthonormal(data.base)
    own = [_off(base, change) for change in changes.values()]
    distance = np.zeros((len(own), len(own)))
    for b, effect in enumerate(changes):
        bases = [orthonormal(_off(base, columns)) for columns in grids[effect]]
        for a, change in enumerate(own):
            left = [np.linalg.norm(_off(basis, change)) for basis in bases]
            distance[a, b] = np.linalg.norm(change) if a == b else min(left)
    names = tuple(f"{e.name.replace('_', ' ')} {_short(e)}".strip() for e in changes)
    return Isolability(names, distance)


def _short(effect: Effect) -> str:
    """Return a place without the joint: a side, a sensor, or the bench."""
    words = effect.where.split()
    rest = words if words[0] == "bench" else words[2:]
    return f"({' '.join(rest)})" if rest else ""


def _off(basis: Array, columns: Array) -> Array:
    return np.asarray(columns - basis @ (basis.T @ columns))


def _least(data: RegressionData, effect: Effect) -> tuple[Array, Array] | None:
    """Return the whitened change (M,) of an effect of the smallest size of interest, its columns.

    None where it has no such size, or does not show on these records.
    """
    explanation = smallest_effect(effect, data.rig)
    if explanation is None:
        return None
    (used,) = explanation.effects
    entries: list[VariantColumns] = variant_columns(data, [Used(effect, used.shape)])
    if not entries:
        return None
    (entry,) = entries
    sizes = {"": 1.0, **explanation.beta}
    change = entry.columns @ np.array([sizes.get(n, 0.0) for n in entry.names])
    return np.asarray(change), entry.columns


def picture(found: Isolability) -> str:
    """Draw the matrix: dark where an effect stands out of the noise beside another."""
    K = len(found.names)
    steps = np.clip(np.floor(2 * np.log10(np.maximum(found.distance, 1.0))), 0, 8).astype(int)
    shades = mpl.colormaps["Blues"](np.linspace(0.0, 0.9, 9))
    with style():
        made = figure(0.175 * K + 2.4, 0.175 * K + 2.2)
        axes = made.add_subplot()
        for row, classes in enumerate(steps):
            ends = np.flatnonzero(np.diff(classes, prepend=-1, append=-1))
            for start, stop in itertools.pairwise(ends.tolist()):
                span = [(start - 0.5, stop - start)]
                axes.broken_barh(span, (row - 0.5, 1.0), color=shades[classes[start]], lw=0)
        for a, b in zip(*np.nonzero(found.distance < SEEN), strict=True):
            alone = found.distance[a, a] >= SEEN
            axes.text(b, a, "×" if alone else "·", color="#d55e00" if alone else INK,
                      ha="center", va="center_baseline", fontsize=9)  # fmt: skip
        for k in range(0, 9, 2):
            axes.plot([], [], "-", color=shades[k], lw=6, label=f"{10 ** (k // 2):,}")
        axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=5, frameon=False,
                    title="remaining residual, standard deviations of noise")  # fmt: skip
        axes.set(xlim=(-0.5, K - 0.5), ylim=(K - 0.5, -0.5), aspect="equal")
        axes.set_xticks(range(K), found.names, rotation=90, fontsize=6)
        axes.set_yticks(range(K), found.names, fontsize=6)
        axes.set_xlabel("fitted in its place, at any size")
        axes.set_ylabel("present, at its smallest size of interest")
        made.subplots_adjust(left=0.19, right=0.99, bottom=0.2, top=0.93)
        return str(svg(made, "isolability", "Which effects can be separated"))


def sections(found: Isolability, command: str, run: Run) -> list[Section]:
    """Return the page: picture, the pairs that cannot be separated, what is not detected."""
    quiet = [n for k, n in enumerate(found.names) if found.distance[k, k] < SEEN]
    pairs = found.inseparable
    K = len(found.names)
    seen = K - len(quiet)
    return [
        Section("", (
            f"{K} effects at joint 2, its sensors or the bench are each taken at the smallest size "
            f"of interest. Of these, {seen} leave a residual of at least {SEEN:g} standard "
            f"deviations of noise beyond what the baseline absorbs ({PROTOCOL}, "
            f"{len(run.records)} records). Of their {seen * (K - 1)} ordered pairs, {len(pairs)} "
            "cannot be separated: with the other effect fitted in its place, the residual is "
            "below that. The result follows from the records' columns and the noise floor by "
            "linear algebra. At this size, the trace ([trace.md](trace.md)) cannot separate more. "
            "Larger effects and other poses separate more.",
            "Made by:",
            f"```sh\n{command}\n```",
            Picture("matrix.svg", picture(found), "Rows: the effect that is present. Columns: "
                    "the effect fitted in its place; none on the diagonal. Crosses: detected "
                    "alone, but not separated from the other. Dots: not detected."),
            Table("Detected, but not separated from another effect (standard deviations of noise)",
                  ("present", "fitted in its place", "residual", "remaining residual"),
                  [[a, b, f"{alone:.0f}", f"{left:.1f}"] for a, b, alone, left in pairs]),
            "Not detected at their smallest size of interest: "
            + (", ".join(quiet) or "none") + ".",
        )),
    ]  # fmt: skip
