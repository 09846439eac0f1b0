"""Rules of the trace's judgement, and how each is switched off or broken.

`RULES` are switched off one at a time by the study `ablations`; `FAULTS` break a rule or a
statistic, and the tests assert that each of both is noticed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, is_dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from analysis.effects.friction import Friction
from analysis.effects.measurement_delay import TimingError
from analysis.effects.measurement_scale import SensorOffset
from analysis.effects.supply import LineDrop
from analysis.effects.valve import SpoolOffset
from analysis.regression import solve
from analysis.signals.settings import SIGNALS
from analysis.trace import (
    engine,
    finding,
    fitted_model,
    free_forms,
    in_motion,
    judging,
    unmeasured_noise,
)
from analysis.trace.data import noise_floor, regression_data, trace_rows
from analysis.trace.judge import alternatives, gates, held_out, inference, rivals
from analysis.trace.search import exchanges, extensions, forward_search, linear_fit
from analysis.trace.search.hypothesis_set import HypothesisSet
from analysis.trace.settings import DATA, SEARCH, TRACE
from analysis.trace.stages import conclusion, one_bandwidth, other_bandwidths, preparation
from rig.model.records import bandwidth_of

Array = NDArray[np.float64]
Change = tuple[Any, str, Any]


@dataclass(frozen=True)
class Rule:
    """A rule: what its absence means, and the (object, attribute, value) that switch it off.

    `refits`: the fits themselves change, and none may be kept from another rule's trace.
    `comparable`: what replaces its functions changes nothing, and may be called beside them.
    """

    name: str
    off: str
    changes: tuple[Change, ...]
    refits: bool = False
    comparable: bool = True


@contextmanager
def switched_off(rule: Rule) -> Iterator[None]:
    """Trace without a rule while the context lasts."""
    kept: list[Change] = []
    try:
        for subject, name, value in rule.changes:
            kept.append((subject, name, getattr(subject, name)))
            _put(subject, name, value)
        yield
    finally:
        for subject, name, value in reversed(kept):
            _put(subject, name, value)


@contextmanager
def watched(rules: Sequence[Rule]) -> Iterator[set[str]]:
    """Trace with all rules while the context lasts; yields the rules that act, by name.

    A rule acts if what replaces any of its functions returns anything else on any call. One that
    changes settings, or that is not `comparable`, counts as acting.
    """
    acting: set[str] = set()
    with ExitStack() as stack:
        for rule in rules:
            if not (rule.comparable and all(callable(value) for *_, value in rule.changes)):
                acting.add(rule.name)
                continue
            for subject, name, other in rule.changes:
                both = _compared(rule.name, getattr(subject, name), other, acting)
                stack.enter_context(switched_off(Rule("", "", ((subject, name, both),))))
        yield acting


def _compared(
    rule: str, function: Callable[..., Any], other: Callable[..., Any], acting: set[str]
) -> Callable[..., Any]:
    """Return a function that adds its rule to `acting` where the other returns anything else."""

    def noted(values: Iterator[Any]) -> Iterator[Any]:
        for value in values:  # one that is replaced yields nothing
            acting.add(rule)
            yield value

    def called(*arguments: Any, **named: Any) -> Any:
        result = function(*arguments, **named)
        if isinstance(result, Iterator):
            return noted(result)
        if rule not in acting and not _same(result, other(*arguments, **named)):
            acting.add(rule)
        return result

    return called


def _same(one: Any, other: Any) -> bool:
    """Return whether two results are known to be the same; arrays in them count as unlike."""
    if one is other:
        return True
    try:
        return bool(one == other)
    except ValueError:
        return False


def _put(subject: Any, name: str, value: Any) -> None:
    """Set an attribute, that of the frozen settings too."""
    if is_dataclass(subject) and not isinstance(subject, type):
        object.__setattr__(subject, name, value)
    else:
        setattr(subject, name, value)


def setting(name: str, value: Any) -> Change:
    """Return a change of one of the trace's settings."""
    return TRACE, name, value


def _one_candidate(
    candidates: linear_fit.CandidateColumns, train_data: Any, residual: Array, rng: Any
) -> Array:
    """Return the gain of the candidate that stands first under each flip, of no other."""
    r = inference.sign_flipped(train_data, rng, residual)
    r = r - candidates.basis @ (candidates.basis.T @ r)
    size = np.maximum(np.diag(candidates.K), 1e-300)
    first = int(np.argmax(size > candidates.visibility_limit))
    gain: Array = (candidates.columns[:, first] @ r) ** 2 / size[first]
    return gain


def _single_rows(train_data: Any, *_: Any, **__: Any) -> NDArray[np.int64]:
    return np.arange(train_data.base.shape[0])


def _widths(factor: float) -> Callable[[Any, Any], Array]:
    true = solve.half_width
    return lambda std, dof: factor * np.asarray(true(std, dof))


def _floors(factor: float) -> Callable[..., list[noise_floor.Floor]]:
    true = noise_floor.floors

    def scaled(*arguments: Any) -> list[noise_floor.Floor]:
        return [replace(f, noise=factor * f.noise) for f in true(*arguments)]

    return scaled


def _same_records() -> Callable[..., Any]:
    """Return a `regression_data` that gives the training records where held-out ones are asked."""
    true, seen = regression_data.regression_data, {}

    def fitted_again(rig: Any, terms: Any, members: Any, beta: Any = None, **_: Any) -> Any:
        if beta is None:
            seen["fitted"] = true(rig, terms, members)
        return seen["fitted"]

    return fitted_again


def _first_repeat(train_data: regression_data.RegressionData) -> Array:
    """Return the first repeat's residual as if it were the average of all."""
    weights = np.zeros(train_data.residual.shape[1])
    for s in train_data.segments:
        weights[s.where] = np.sqrt(s.repeats)
    return np.asarray(train_data.residual[0] * weights)


RULES: Final = (
    Rule("removes on held-out", "held-out errors say nothing for or against an effect",
         (setting("least_removed", -math.inf),
          (held_out, "disturbed_in_held_out", lambda *_: []))),
    Rule("no harm elsewhere", "an effect may increase the residual of another equation",
         (setting("harm_ratio", math.inf),)),
    Rule("physics", "any sign, size and shape passes",
         ((HypothesisSet, "physical_problem", lambda *_, **__: ""),)),
    Rule("invariance", "a size may differ between steps, halves, directions and speeds",
         ((gates, "invariance", lambda *_: []),)),
    Rule("family-wise p", "no significance test", (setting("p_limit", 1.0),)),
    Rule("rivals", "no other effect counts as tied", ((rivals, "rivals_of", lambda *_: []),)),
    Rule("rivals that matter",
         "a rival with further numbers must remove the price of each, whatever it means",
         ((alternatives, "moved_parameter", lambda *_: None),
          (rivals, "moved_parameter", lambda *_: None))),
    Rule("two in place of one", "two effects are no rival of one",
         ((rivals, "tied_pairs", lambda *_: []),)),
    Rule("small effects", "an effect too small to be named widens no interval",
         ((fitted_model, "sets_with_small_effect", lambda *_: []),)),
    Rule("open parameters", "a richer name that leaves another parameter open is no rival",
         (setting("open_share", math.inf),)),
    Rule("free run", "the held-out free run may fail with the effects or be far worse",
         ((held_out, "worse_free_run", lambda *_: ""),)),
    Rule("twins", "effects that no data can separate are not listed as rivals",
         ((LineDrop, "inseparable_beside", lambda *_: ()),
          (SpoolOffset, "inseparable", lambda *_: ()),
          (SensorOffset, "inseparable", lambda *_: ()))),
    Rule("usual cause", "equal delays of all pistons and pressures stay named so",
         ((TimingError, "usual_beside", lambda *_: ()),)),
    Rule("held-out band", "any held-out error may remain", (setting("held_out_band", math.inf),)),
    Rule("held-out rows choose", "where training rows hold noise alone, they choose alone",
         ((judging, "_shown_by_held_out_rows", lambda _sets, winner, _rows: winner),)),
    Rule("further search", "no further effect is searched for in single equations",
         ((free_forms, "extended_in", lambda *_: None),
          (judging, "extended_in", lambda *_: None))),
    Rule("price of parameters", "a further parameter costs nothing",
         ((SEARCH, "number_price", 0.0), (SEARCH, "simpler_ratio", 1.0),
          (SEARCH, "add_share", 0.0)),
         refits=True),
    Rule("pruning", "effects that remove little are kept",
         ((HypothesisSet, "prune", lambda _, one: one),)),
    Rule("pairs", "no pair of effects is tried at once",
         ((linear_fit, "best_pairs", lambda *_: []),
          (linear_fit, "pairs_of_chambers", lambda *_: []))),
    Rule("tied sets", "of sets that cannot be separated, the one found first is named",
         ((judging.Judge, "_best_tied_set", lambda _, found: found),)),
    Rule("exact forms", "the form of a gain, an offset or a mass may miss as much as any other",
         ((gates, "form_share", lambda *_: TRACE.held_out_share),)),
    Rule("tolerances", "areas, volumes and pin distances are taken as the rig file states them",
         ((one_bandwidth, "geometry_for_smaller_set", lambda *_: None),)),
    Rule("repeats that differ", "channels of repeats are averaged, however their motions differ",
         ((DATA, "averaging_error", math.inf),), refits=True),
    Rule("oil of another day", "viscous friction and bulk modulus are the same on any day",
         (setting("viscosity_change", 0.0), setting("bulk_change", 0.0))),
    Rule("unstated noise", "where nothing repeats, noise is at most that above the rows",
         ((preparation, "unstated_noise", lambda *_: {}),)),
    Rule("steady noise", "more than 2.5 floors that no effect explains are never noise",
         ((unmeasured_noise, "_follows_motion", lambda *_: True),)),
    Rule("unphysical companion", "all effects of a set with an unphysical one are refused",
         ((judging.Judge, "_unphysical_of", lambda *_: []),)),
    Rule("loud slow rows", "a clean result is never traced again in rows of lower frequencies",
         (setting("loud_ratio", math.inf),)),
    Rule("ties in slow rows", "tied sets are not compared in rows of lower frequencies",
         ((other_bandwidths, "_sets_that_may_hold", lambda *_: [[]]),)),
    Rule("narrower rows", "what rows of all frequencies leave unexplained stays so",
         ((engine, "traced_in_narrower_rows", lambda *_: (None, ())),)),
    Rule("wider rows", "what rows for the motion show clean is clean",
         ((engine, "traced_in_wider_rows", lambda *_: None),)),
    Rule("filtered path", "friction reverses along the path as it is measured, noise included",
         ((SIGNALS, "path_noise", math.inf),), refits=True),
    Rule("noise above the rows", "where nothing repeats, the floor is the stated noise",
         ((noise_floor, "noise_above_rows", lambda *_: {}),)),
    Rule("noise with a memory", "only noise above the rows counts where repeats show far more",
         ((DATA, "coloured_ratio", 0.0),), refits=True),
    Rule("hum above the rows", "lines above the rows count as noise",
         ((noise_floor, "_spectral_ratio", lambda _, r, n: float(np.std(r) / np.std(n))),)),
    Rule("noise in the residual", "noise above the rows counts where the rows hold less",
         ((noise_floor, "_within_residual", lambda _, ratios: ratios),)),
    Rule("noise of the samples", "neighbouring states may show less than the samples' noise",
         ((noise_floor, "_at_least", lambda floor, _: floor),)),
    Rule("training's bandwidth", "rows are filtered for the quickest motion of all records",
         ((engine, "_bandwidth_of_rows", lambda _, all_runs: bandwidth_of(all_runs)),)),
    Rule("without a form", "a name that has no form may miss as much as one that has",
         ((free_forms, "_within_form_tolerance", lambda h, o: h.within_form_tolerance(o)),)),
    Rule("line no noise", "a torque in time counts as noise by neighbouring states",
         ((noise_floor, "_largest_line", lambda *_: 0.0),)),
    Rule("noise beside effects",
         "noise by neighbouring states is that of the residual without effects",
         ((preparation, "noise_beside_effects", lambda *_: {}),)),
    Rule("other starts", "a search that explains nothing does not begin with another effect",
         ((forward_search, "_begun_with_another", lambda _, current, _singles: current),)),
    Rule("exchanges", "no effect is exchanged for another one",
         ((judging, "exchanged", lambda _, now: now),
          (exchanges, "_with_another", lambda *_: []))),
    Rule("two for one", "no effect is exchanged for two that leave less",
         ((exchanges, "_with_two_for_one", lambda *_: []),)),
    Rule("fewer effects", "an effect is added where another set of fewer leaves as little",
         ((extensions, "_smaller_sets", lambda *_: []),)),
    Rule("parts of a law", "a breakaway and the level below it are tried one by one",
         tuple((module, "with_parts_beside", lambda *_: iter(()))
               for module in (alternatives, extensions, judging))),
    Rule("begun anew", "a search of shapes that ended in a local minimum is not begun anew",
         ((HypothesisSet, "refined_below",
           lambda kept, _, effects, rival: kept.refined(effects, rival)),),
         comparable=False),
    Rule("nearer start", "a further effect begins at its size by first-order columns",
         ((extensions, "at_best_size", lambda _, used, _others: used),)),
    Rule("exact columns", "first-order columns alone find the effects",
         ((judging, "improved_by_exact_trials", lambda _sets, now: now),)),
    Rule("unknown cause", "names beside an unknown cause need no more than other names do",
         ((judging, "judged_beside_unknown_cause", lambda _sets, _set, effects, _left: effects),)),
    Rule("simpler name", "an effect that equals a simpler one is refused, and that one not tried",
         ((HypothesisSet, "simpler_sets", lambda *_: []),)),
    Rule("second form", "an effect is tried in its first form only",
         ((Friction, "other_form_starts", lambda *_: ()),), refits=True),
    Rule("rests", "what stays while a joint rests speaks against its dry friction",
         ((in_motion, "searched_in_motion", lambda *given: given[-1]),
          (conclusion, "joints_with_friction", lambda *_: set()))),
    Rule("force at standstill", "rows in motion alone decide whether a breakaway acts",
         ((in_motion, "_hides_breakaway", lambda *_: False),)),
    Rule("free form beside", "a free form beside an unknown cause in other equations is not named",
         ((free_forms, "_named_beside_unknown_cause", lambda *_: None),)),
    Rule("free forms", "no mechanism without a named form",
         ((judging, "explained_by_free_form", lambda *_: None),)),
)  # fmt: skip

FAULTS: Final = (
    Rule("p always 0", "every gain is significant",
         ((inference, "p_value", lambda *_: 0.0),)),
    Rule("no family", "the null is one candidate's, not the largest of all",
         ((inference, "null_maximum", _one_candidate),)),
    Rule("flips by sample", "noise with a memory counts as many independent samples",
         ((inference, "flip_blocks", _single_rows),)),
    Rule("harm never seen", "no equation is said to get worse",
         ((held_out, "disturbed_equations", lambda *_: []),
          (held_out, "disturbed_in_held_out", lambda *_: []))),
    Rule("held-out floor x 2", "held-out errors of 3 times the floor pass",
         (setting("held_out_band", 3.0),)),
    Rule("form tolerance x 10", "half of what repeated may stay",
         (setting("held_out_share", 1.0),)),
    Rule("floor x 0.3", "the noise is taken for a third", tuple(
        (module, "floors", _floors(0.3)) for module in (noise_floor, regression_data)), True),
    Rule("floor x 3", "the noise is taken for three times as large", tuple(
        (module, "floors", _floors(3.0)) for module in (noise_floor, regression_data)), True),
    Rule("least floor", "the floor may lie anywhere below the stated noise",
         ((DATA, "least_noise", 0.0),), refits=True),
    Rule("fit records judge", "the records that were fitted are those that judge",
         ((trace_rows, "regression_data", _same_records()),), True),
    Rule("same records pass", "a held-out record may be a training record",
         ((engine, "refuse_repeated_records", lambda *_: None),)),
    Rule("first repeat alone", "the average is the first repeat",
         ((regression_data.RegressionData, "mean_residual", property(_first_repeat)),), True),
    Rule("intervals x 0.5", "intervals are half as wide",
         ((inference, "half_width", _widths(0.5)),)),
    Rule("intervals x 3", "intervals are three times as wide",
         ((inference, "half_width", _widths(3.0)),)),
    Rule("tolerance x 10", "a size may differ twofold between parts",
         (setting("invariance_tolerance", 2.0),)),
    Rule("nothing is left", "whatever stays counts as nothing",
         ((finding, "remainders", lambda *_: ()), (judging, "remainders", lambda *_: ()),
          (gates, "held_out_above_band", lambda *_: []))),
    Rule("judging rows unread", "nobody asks what the judging rows keep",
         ((conclusion, "judging_rows_above_band", lambda *_: (set(), [])),)),
)  # fmt: skip


def by_name(rules: tuple[Rule, ...]) -> Mapping[str, Rule]:
    """Return rules by their names."""
    return {rule.name: rule for rule in rules}
