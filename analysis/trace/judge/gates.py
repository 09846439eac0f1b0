"""Naming gates: significance is not naming, so a name must pass all of these.

A deterministic misfit makes every correlated candidate significant. What tells the cause from its
look-alikes is that it works on records of another excitation, at a physical size, with the same
coefficient everywhere, whichever repeats are taken, and better than anything else.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from analysis.effects.base import Effect, shapes_of
from analysis.regression.solve import half_width
from analysis.simulation.model import Estimate
from analysis.terms.base import Used
from analysis.trace.data.regression_data import Board
from analysis.trace.judge import inference
from analysis.trace.judge.held_out import left as held_left
from analysis.trace.judge.invariance import invariance
from analysis.trace.result import Found, Gate, Rival
from analysis.trace.search.hypothesis import Listed, excess_of, parameter_values
from analysis.trace.search.hypothesis_set import Shortlist
from analysis.trace.search.linear_fit import FORM

Array = NDArray[np.float64]
Key = tuple[str, str]

REMOVED = 0.5  # of the held-out energy above noise in the equations it touches
CHOSEN = 0.9  # of half-samples
P_LIMIT = 0.01
TIE = 1.10  # held-out rms of a rival over the best's: below, the data do not tell them apart
TIE_TRAINING = 1.25
HARM = 1.2  # energy above noise in an equation over that before: a cause does not make it worse
HELD_FORM, HELD_QUIET = 0.05, 1.3  # share that may stay where the held-out error is this small
HELD_BAND = 1.5  # held-out rms after over the noise floor, per equation
SHOWN = 4  # rivals in a result

REMOVES, PHYSICAL, INVARIANT, STABLE, SIGNIFICANT, ALONE = (
    "removes on held-out", "physical", "invariant", "stable", "significant", "no rival",
)  # fmt: skip


def stands(found: Found) -> bool:
    """Tell whether an effect passes every gate but that of rivals, which makes it confounded."""
    return all(gate.ok for gate in found.gates if gate.name != ALONE)


def judge(
    listed: Shortlist, winner: Listed, held: Board, rng: np.random.Generator
) -> tuple[Found, ...]:
    """Put every effect of the winner through the gates."""
    stage = listed.stage
    values = parameter_values(stage.rig, winner.fit.terms, dict(winner.fit.beta))
    null = inference.null_maximum(listed.field, stage, _noise_like(stage, winner.fit.left), rng)
    steady = inference.stability(listed, winner, rng)
    after = held_left(held, winner.fit)
    physical = listed.physical(winner)
    out = []
    for used in winner.effects:
        assert isinstance(used.term, Effect)
        key = (used.term.name, used.term.where)
        rest = listed.exact(tuple(u for u in winner.effects if u is not used))
        rivals = _rivals(listed, winner, key, held, after)
        removed = _removed(held, rest, after, _touched(listed, winner, rest))
        worse = _worse(listed, winner, rest)
        p = inference.p_value(rest.fit.energy - winner.fit.energy, null)
        errors = inference.spread(stage, winner.fit, used, values)
        share, others = steady[key]
        differing = invariance(stage, winner.fit, used, errors, _joint(used.term))
        tied = [r for r in rivals if r.tied]
        twins = [Rival(name, where, 1.0, 1.0, True) for name, where in used.term.twins()]
        gates = (
            Gate(REMOVES, removed >= REMOVED and not worse, _taken(removed, worse)),
            Gate(PHYSICAL, not physical, physical or "sign and size are"),
            Gate(INVARIANT, not differing, _differences(differing)),
            Gate(STABLE, share >= CHOSEN or bool(tied), _chosen(share, others, bool(tied))),
            Gate(SIGNIFICANT, p <= P_LIMIT, f"family-wise p = {p:.3g}"),
            Gate(ALONE, not (tied or twins), _told_apart([*twins, *rivals])),
        )
        out.append(
            Found(
                used.term.name, _place(used.term), _parameters(stage, used, errors), p, removed,
                (*twins, *rivals), gates, used.term.variable,
            )
        )  # fmt: skip
    return tuple(out)


def remaining(listed: Shortlist, winner: Listed, held: Board) -> list[tuple[str, str]]:
    """Return the equations that keep more than the noise floor's band, and say on which records.

    What a catalogue's simpler form leaves in the training records may be somewhat more where the
    held-out error of that equation is the noise's.
    """
    after = held_left(held, winner.fit)
    start = excess_of(held, held_left(held, listed.empty.fit))
    now = excess_of(held, after)
    ratio = _held_ratio(held, after)
    out = []
    for e, left in winner.excess.items():
        share = left / max(listed.empty.excess[e], 1e-30)
        quiet = share <= HELD_FORM and ratio.get(e, np.inf) <= HELD_QUIET
        if not (quiet or listed.negligible(e, left)):
            times = left / listed.limits.band[e]
            out.append(
                (e, f"{100 * share:.2g} % of what repeated stays, {times:.2g} times the band")
            )
    out += [
        (e, f"held-out error {r:.2f} times the noise floor")
        for e, r in ratio.items()
        if r > HELD_BAND and now[e] > 2 * FORM * start[e]
    ]
    return out


def _held_ratio(held: Board, left: Array) -> dict[str, float]:
    """Return the held-out error of single records over the noise floor, by equation."""
    floor: dict[str, float] = {}
    energy: dict[str, float] = {}
    for s in held.segments:
        count = (s.where.stop - s.where.start) * s.repeats
        floor[s.equation] = floor.get(s.equation, 0.0) + count * s.noise**2
        # Averaging has taken noise out: put back what a single record would show.
        part = left[s.where]
        found = float(part @ part) + count * (1 - 1 / s.repeats)
        energy[s.equation] = energy.get(s.equation, 0.0) + found * s.noise**2
    return {e: float(np.sqrt(energy[e] / floor[e])) for e in floor}


def _noise_like(stage: Board, left: Array) -> Array:
    """Return the repeats' residuals without what repeats: (R, M), scaled to the full noise.

    Of a step with one repeat, what the winner leaves (M,).
    """
    out = stage.left.copy()
    for s in stage.segments:
        if s.repeats > 1:
            part = out[: s.repeats, s.where]
            scale = np.sqrt(s.repeats / (s.repeats - 1))
            out[: s.repeats, s.where] = (part - part.mean(axis=0)) * scale
        else:
            out[0, s.where] = left[s.where]
    return out


def _joint(effect: Effect) -> int | None:
    words = effect.where.split()
    return int(words[1]) - 1 if words[0] == "joint" else None


def _place(effect: Effect) -> str:
    return str(getattr(effect, "place", effect.where))


def _touched(listed: Shortlist, winner: Listed, rest: Listed) -> set[str]:
    """Return the equations in which an effect changes the training residual visibly."""
    change = {e: rest.excess[e] - winner.excess[e] for e in rest.excess}
    most = max(change.values())
    return {e for e, v in change.items() if v > 0.05 * most}


def _worse(listed: Shortlist, winner: Listed, rest: Listed) -> list[str]:
    """Return equations that were quieter under the baseline and that this effect disturbs."""
    return [
        e
        for e, now in winner.excess.items()
        if not listed.negligible(e, now)
        and now > HARM * max(0.0, listed.empty.excess[e])
        and now > rest.excess[e]
    ]


def _taken(removed: float, worse: Sequence[str]) -> str:
    text = f"{100 * removed:.0f} % of what repeats"
    return f"{text}, but more is left of {' '.join(worse)} than before" if worse else text


def _removed(held: Board, rest: Listed, after: Array, touched: set[str]) -> float:
    before = excess_of(held, held_left(held, rest.fit))
    now = excess_of(held, after)
    start = sum(max(0.0, before[e]) for e in touched if e in before)
    end = sum(max(0.0, now[e]) for e in touched if e in now)
    return (start - end) / start if start > 0 else 0.0


def _rivals(listed: Shortlist, winner: Listed, key: Key, held: Board, after: Array) -> list[Rival]:
    """Return the sets that have another effect in place of one, those that leave least first."""
    others = winner.keys - {key}
    rest = listed.exact([u for u in winner.effects if (u.term.name, u.term.where) != key])
    equations = _touched(listed, winner, rest)
    out = []
    mine = _energy(held, after)
    own = _energy(listed.stage, winner.fit.left)
    for one in listed.listed.values():
        fresh = one.keys - winner.keys
        if key in one.keys or not others <= one.keys or len(fresh) != 1:
            continue
        if one.size[1] > winner.size[1] or listed.physical(one):
            continue
        theirs = _energy(held, held_left(held, one.fit))
        ratio = _ratio(theirs, mine, equations)
        training = _ratio(_energy(listed.stage, one.fit.left), own, equations)
        name, _ = next(iter(fresh))
        tied = ratio < TIE and (training < TIE_TRAINING or ratio < 0.95)
        place = next(_place(u.term) for u in one.effects if (u.term.name, u.term.where) in fresh)  # type: ignore[arg-type]
        out.append(Rival(name, place, ratio, training, tied))
    out.sort(key=lambda r: r.ratio)
    return out[:SHOWN]


def _energy(stage: Board, left: Array) -> dict[str, tuple[float, int]]:
    out: dict[str, tuple[float, int]] = {}
    for s in stage.segments:
        part = left[s.where]
        energy, rows = out.get(s.equation, (0.0, 0))
        out[s.equation] = energy + float(part @ part), rows + len(part)
    return out


def _ratio(
    one: Mapping[str, tuple[float, int]], other: Mapping[str, tuple[float, int]],
    equations: set[str],
) -> float:  # fmt: skip
    shared = [e for e in one if e in equations and e in other]
    above, below = sum(one[e][0] for e in shared), sum(other[e][0] for e in shared)
    return float(np.sqrt(above / below)) if below > 0 else float("nan")


def _parameters(stage: Board, used: Used, errors: inference.Spread) -> dict[str, Estimate]:
    units = {c.parameter: c.unit for c in used.term.coefficients(stage.rig)}
    units |= {s.parameter: s.unit for s in shapes_of(stage.rig, used)}
    half = half_width(errors.std, np.full(len(errors.std), errors.dof))
    return {
        name: Estimate(float(v), units.get(name, ""), float(s), (float(v - h), float(v + h)))
        for name, v, s, h in zip(errors.names, errors.value, errors.std, half, strict=True)
    }


def _differences(differing: Sequence[tuple[str, str, float, float]]) -> str:
    if not differing:
        return "the same in every step, half, direction and speed"
    return "; ".join(
        f"{name} = {value:.3g} ± {error:.2g} in {label}"
        for label, name, value, error in differing[:3]
    )


def _chosen(share: float, others: Mapping[str, int], tied: bool) -> str:
    text = f"chosen in {100 * share:.0f} % of half-samples"
    if share < CHOSEN and tied:
        text = f"not asked, for a rival fits as well: {text}"
    if share < CHOSEN and others:
        text += "; else " + ", ".join(sorted(others, key=lambda k: -others[k])[:2])
    return text


def _told_apart(rivals: Sequence[Rival]) -> str:
    if not rivals:
        return "none came near"
    nearest = rivals[0]
    words = "cannot be told from" if nearest.tied else "the nearest is"
    return f"{words} {nearest.name} at {nearest.where}: {nearest.ratio:.2f} times the held-out rms"
