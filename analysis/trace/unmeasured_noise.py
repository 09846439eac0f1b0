"""Noise that nothing repeated shows: what a model leaves, where that follows nothing."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from analysis.regression.conditioned import ConditionedRecord
from analysis.regression.solve import numbered, sums_of
from analysis.trace.clues.dependence import BY_BALANCE, clues_to
from analysis.trace.data.candidates import at_start
from analysis.trace.data.conditioned_record import model_rows
from analysis.trace.data.noise_floor import ABOVE, NEIGHBOURS, STATED, floors
from analysis.trace.data.regression_data import RegressionData
from analysis.trace.finding import Finding
from analysis.trace.judge import gates
from analysis.trace.result import CONFOUNDED, EXPLAINED, UNEXPLAINED
from analysis.trace.search.hypothesis import Hypothesis, effect_of
from analysis.trace.settings import DATA, TRACE

Array = NDArray[np.float64]


def unstated_noise(finding: Finding) -> dict[str, float]:
    """Return what `finding` leaves over the stated noise, by equation, where nothing repeats.

    Equations whose noise a step shows by repeats, periods or neighbouring states keep their floors.
    Empty where each has one, where a variable of the records removes a part of what is left from
    held-out records, or an effect that the gates refuse, and where more than `DATA.unstated_ratio`
    floors is left, or an effect explains the rest: but for `DATA.steady_ratio` floors of a residual
    that is as large at rest as in motion, as noise is.
    """
    data = finding.rows.train
    measured = {f.equation for f in data.floors if f.source not in (STATED, ABOVE)}
    winner = _with_fitting_effects(finding)
    over_stated = {(f.group, f.equation): f.noise / f.stated for f in data.floors}
    left: dict[str, list[Array]] = {}
    stated: dict[str, list[Array]] = {}
    for s in data.segments:
        if s.equation not in measured:
            residual = winner.fit.residual[s.where]
            left.setdefault(s.equation, []).append(residual)
            stated.setdefault(s.equation, []).append(residual * over_stated[s.group, s.equation])
    most = max(map(_rms, left.values()), default=0.0)
    explained = finding.verdict != UNEXPLAINED
    if most <= (TRACE.held_out_band if explained else 0.0) or most > DATA.steady_ratio:
        return {}
    refused = gates.refused_effects(finding.effects)
    if any(gates.removes(f) and not gates.passes_but_beside_unknown_cause(f) for f in refused):
        return {}
    steady = explained or most > DATA.unstated_ratio
    if steady and any(_follows_motion(data, winner, e) for e in left):
        return {}
    clues, formulas = clues_to(data, finding.rows.choosing, winner, ())
    # Noise of a variable that the balance gives is in the residual as it is in the variable.
    causes = [clue for clue in clues if not clue.words.endswith(BY_BALANCE)]
    if formulas or any(clue.share > DATA.unstated_clue for clue in causes):
        return {}
    return {name: max(1.0, _rms(parts)) for name, parts in stated.items()}


def _rms(parts: list[Array]) -> float:
    return float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))


def _follows_motion(data: RegressionData, winner: Hypothesis, equation: str) -> bool:
    """Return whether what a set leaves in an equation may be larger where the machine moves more.

    The records are cut into windows of `DATA.motion_window`. Where a motion of a moving joint
    (speed, spool or drive, change of a pressure) is in its upper third, the rms of the residual may
    be at most `DATA.motion_ratio` times that in its lower third. Motions that are less than
    `DATA.motion_contrast` times as large there show nothing, and windows that are too few.
    """
    of_group = {
        conditioned.group: (conditioned, rows)
        for conditioned, rows in zip(data.records, data.rows, strict=True)
    }
    parts = []
    for segment in data.segments:
        if segment.equation == equation:
            conditioned, rows = of_group[segment.group]
            time, residual = rows[equation].time, winner.fit.residual[segment.where]
            squares = np.column_stack((residual, _motion(conditioned, time))) ** 2
            window = np.floor(time / DATA.motion_window).astype(np.int64)
            _, number = numbered(window)
            parts.append(sums_of(squares, number) / np.bincount(number)[:, None])
    means = np.vstack(parts)
    if len(means) < DATA.least_windows:
        return True
    energies, motions = means[:, 0], means[:, 1:]
    least, most = np.quantile(motions, (1 / 3, 2 / 3), axis=0)
    shown = []
    for m, low, high in zip(motions.T, least, most, strict=True):
        quiet, active = m <= low, m >= high
        if np.mean(m[active]) >= DATA.motion_contrast**2 * np.mean(m[quiet]):
            shown.append(np.mean(energies[active]) / max(np.mean(energies[quiet]), 1e-300))
    return not shown or bool(max(shown) > DATA.motion_ratio**2)


def _motion(conditioned: ConditionedRecord, time: Array) -> Array:
    """Return the moving joints' speeds, spools and pressure changes (m, k) at instants (m,)."""
    signals, at = conditioned.signals, conditioned.samples_at(time)
    changes = (np.gradient(p, axis=0) for p in (signals.p_cap, signals.p_rod))
    kinds = (signals.qd, signals.u, *changes)
    return np.column_stack([kind[np.ix_(at, signals.moving)] for kind in kinds])


def noise_beside_effects(finding: Finding) -> dict[str, float]:
    """Return the noise by neighbouring states of what the named effects leave, over the stated.

    It is given by equation.

    Without dry friction the residual jumps with the direction of motion between two such states: a
    floor was 20 times too large, and a constant force beside the friction was lost in it. Equations
    whose noise does not get smaller than `DATA.finer_noise` of what it was are left out.
    """
    data, fit = finding.rows.train, finding.winner.fit
    before = {(f.group, f.equation): f.noise for f in data.floors if f.source == NEIGHBOURS}
    if not before or finding.verdict not in (EXPLAINED, CONFOUNDED):
        return {}
    rows = [model_rows(data.rig, fit.terms, record) for record in data.records]
    after = floors(data.rig, fit.terms, data.records, rows, fit.beta)
    ratios: dict[str, list[float]] = {}
    for floor in after:
        noise = before.get((floor.group, floor.equation))
        if noise is not None and floor.noise < DATA.finer_noise * noise:
            ratios.setdefault(floor.equation, []).append(floor.noise / floor.stated)
    return {e: float(np.sqrt(np.mean(np.square(values)))) for e, values in ratios.items()}


def _with_fitting_effects(finding: Finding) -> Hypothesis:
    """Return the set of a finding with the effects that only a tie or the noise keeps unnamed."""
    fitting = [
        effect_of(f.name, f.at) for f in finding.effects if gates.passes_but_beside_unknown_cause(f)
    ]
    if len(fitting) == len(finding.winner.effects):
        return finding.winner
    rig = finding.rows.train.rig
    return finding.hypotheses.refined([at_start(rig, effect) for effect in fitting])
