"""The other methods beside the coupled one: sequential, simultaneous, PSO and GA."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from analysis.identify.result import Identification
from analysis.simulation.validate import RecordValidation
from rig.model import channels as ch
from tests.studies.pages import Section, Table
from tests.studies.reproduction.bench import Reproduction, Simultaneous
from tests.studies.reproduction.numbers import Experiments, oil_temperatures
from tests.studies.reproduction.page import DASH, error, means, percent, scale_of, shown, worst
from tests.studies.reproduction.searches import fit, share

METHODS = Section(
    "The methods",
    (
        "**Coupled** (`--method coupled`, the paper's): the rows of all three steps are stacked "
        "and solved once by least squares, so that a parameter that shows in several steps has "
        "one value. No simulation, no initial guess.",
        "**Sequential** (`--method sequential`): one step after the other. E1 takes a parameter "
        "from the first step that determines it (95 % half-width below 2 %) and treats it as "
        "known afterwards; rows with parameters that are still unknown are kept for the next "
        "step. E2 identifies every step by itself and averages. Both are computed; the "
        "estimates reported are E1's, those of E2 and of every step are listed as well.",
        "**Simultaneous** (`--method simultaneous`): the coupled rows and solve, but only of "
        "records that excite every joint at once.",
        "**PSO and GA** (`--method pso`, `--method ga`): search the eight parameters of STEP1 (M2 "
        "Fv2 W2 b and joint 2's gains) by simulation. Two windows of two seconds of STEP1's first "
        "record are simulated from the measured state under the measured spool; the error is the "
        "relative output error of piston and both pressures; each parameter may lie between a "
        "tenth and ten times its nominal value, searched in the logarithm. A candidate whose "
        "chamber pressure leaves 0..supply has no real state (the orifice's root is complex), one "
        "that diverges has none either: both are counted and rank below every valid candidate. "
        "The algorithms are pymoo's, with a seed.",
    ),
)


def sequential(done: Reproduction) -> Section:
    """Show the several values of the sequential method."""
    data = done.sequential.extra["sequential"]
    truth = done.runs.truth
    rows = []
    for name, found in data["per_step"].items():
        own = {e["step"]: e["value"] for e in found}
        apart = data["disagreement"].get(name)
        first, mean = data["E1"][name]["value"], data["E2"][name]["value"]
        rows.append(
            [
                name, scale_of(name)[2], *(_fine(name, own.get(s)) for s in data["steps"]),
                DASH if apart is None else f"{apart:.1f}",
                _fine(name, first), _off(first, truth[name]),
                _fine(name, mean), _off(mean, truth[name]),
                _fine(name, done.coupled.estimates[name].value),
                percent(error(done.coupled.estimates[name].value, truth[name]), 3),
            ]
        )  # fmt: skip
    header = [
        "parameter", "unit", *data["steps"], "apart", "E1", "error %", "E2", "error %", "coupled",
        "error %",
    ]  # fmt: skip
    values = [e["value"] for e in data["per_step"]["b"]]
    ratio = done.sequential.solutions["mechanical"].residual_rms / (
        done.coupled.solutions["mechanical"].residual_rms
    )
    several = data["disagreement"]
    beyond = [name for name, apart in several.items() if apart > 1.0]
    return Section(
        "Sequential: several values for one parameter",
        (
            f"{len(several)} of {len(rows)} parameters are identified by more than one step and "
            f"have as many values. The bulk modulus, which is in every step, has {len(values)}: "
            f"{', '.join(shown('b', v, 2) for v in values)} MPa, {several.get('b', 0.0):.1f} of "
            "their own 95 % intervals apart (column `apart`: difference over the common "
            f"half-width; above 1 are {' '.join(beyond) or 'none'}). {_by_temperature(done)}"
            "STEP2 alone determines only the sum of M1 and R12, so that E1 and E2 keep its rows "
            "for the next step. With E1's values the torque rows keep "
            f"{ratio:.2f} times the residual that the coupled solution leaves.",
            Table("Every step by itself, E1, E2 and coupled", header, rows),
        ),
    )


def _by_temperature(done: Reproduction) -> str:
    """Set the steps' values of b beside their oil's temperature, with the slope of a line."""
    oil = oil_temperatures(done.runs.steps)
    found = done.sequential.extra["sequential"]["per_step"]["b"]
    pairs = [(oil[e["step"]], e["value"]) for e in found if e["step"] in oil]
    if len(pairs) < 3 or len({f"{t:.1f}" for t, _ in pairs}) < 3:
        return ""
    t, b = (np.array(column) for column in zip(*pairs, strict=True))
    slope = 100.0 * float(np.polyfit(t, b, 1)[0]) / float(b.mean())
    return (
        f"The oil was at {', '.join(f'{x:.1f}' for x in t)} °C in these steps: b moves by "
        f"{slope:+.2f} % a kelvin, so that each step's value may be correct for its own oil. E1 "
        "and E2 do not model that; the coupled solution does beside its parameters, and its b is "
        "that of the rig's nominal temperature. "
    )


def _fine(name: str, value: float | None) -> str:
    return shown(name, value, scale_of(name)[1] + 1)


def _off(value: float | None, truth: float) -> str:
    return DASH if value is None else percent(error(value, truth), 3)


def simultaneous(done: Reproduction) -> Section:
    """Show what simultaneous excitation alone gives, with both filters."""
    ours, own = done.simultaneous, done.paper_simultaneous
    rows = []
    for family, theirs in (("mechanical", 22), ("fluid", 27)):
        rows.append(
            [
                f"condition number, {family}", str(theirs),
                *(f"{e.conditions[family].plain[1]:.1f}" for e in (ours.each, own.each)),
                *(f"{e.conditions[family].plain[1]:.1f}" for e in (done.each, done.paper_each)),
            ]
        )  # fmt: skip
    for name in done.each.spreads:
        rows.append(
            [
                f"error of {name} %", DASH,
                *(_error(done, e, name) for e in (ours.each, own.each)),
                *(_error(done, e, name) for e in (done.each, done.paper_each)),
            ]
        )  # fmt: skip
    header = [
        "", "paper, simultaneous", "simultaneous here", "with the paper's filter",
        "coupled here", "with the paper's filter",
    ]  # fmt: skip
    return Section(
        "Simultaneous: one excitation of all joints",
        (
            "Ten seconds of both joints at 1 Hz per experiment, as many experiments as above; "
            "condition numbers in plain SI, as the paper's. Three steps condition the mechanical "
            "rows better than one simultaneous motion, here as in the paper. The effect on the "
            f"result depends on the noise in the rows. {_verdict(done, ours, 'this filter')} "
            f"{_verdict(done, own, 'the filter of the paper')}",
            "The paper calls the method's result impossible because `W1 is larger than W2`; its "
            "own Table III has W1 > W2 too, and masses within their links require W1/l1 >= "
            "W2/l2 >= 0. The check `gravity order` tests that.",
            _oil_of_both(done),
            Table("Simultaneous and coupled, mean of the experiments", header, rows),
        ),
    )


def _oil_of_both(done: Reproduction) -> str:
    both, lock = oil_temperatures(done.runs.both), oil_temperatures(done.runs.steps)
    if not both or not lock:
        return "The oil's temperature was not measured."
    return (
        f"The error of b is against oil at {done.rig.oil.temperature:g} °C; in these records it "
        f"was at {np.mean(list(both.values())):.1f} °C, in those of the three steps at "
        f"{np.mean(list(lock.values())):.1f} °C on average."
    )


def _error(done: Reproduction, each: Experiments, name: str) -> str:
    return percent(error(each.spreads[name].mean, done.runs.truth[name]))


def _verdict(done: Reproduction, one: Simultaneous, filtering: str) -> str:
    name, off = worst(means(one.each), done.runs.truth)
    broken = _unphysical(one)
    W1, W2 = (one.each.spreads[n].mean for n in ("W1", "W2"))
    judged = (
        f"physically impossible (checks failed: {', '.join(broken)})"
        if broken
        else "physically possible"
    )
    return (
        f"With {filtering} the worst parameter is {name}, {off:+.2f} % off, W1 = {W1:.3f} and "
        f"W2 = {W2:.3f} kg·m, and the result is {judged}."
    )


def _unphysical(one: Simultaneous) -> list[str]:
    physical = ("gravity order", "inertia", "signs")
    return [c.name for c in one.found.checks if not c.ok and c.name in physical]


def summary(done: Reproduction) -> Section:
    """Say what each method gives and what it could not do."""
    truth = done.runs.truth
    listed: list[tuple[str, Identification, Sequence[RecordValidation], str]] = [
        ("coupled", done.coupled, done.validation, ""),
        ("sequential E1", done.sequential, done.sequential_fits, "give one value"),
        ("simultaneous", done.simultaneous.found, done.simultaneous.fits, _limits(done)),
        (
            "simultaneous, paper's filter", done.paper_simultaneous.found,
            done.paper_simultaneous.fits, _broken(done.paper_simultaneous),
        ),
        *(
            (method.upper(), s.found, s.fits, _search_limits(s.found))
            for method, s in done.searches.items()
        ),
    ]  # fmt: skip
    rows = []
    for name, found, fits, could_not in listed:
        values = {n: e.value for n, e in found.estimates.items() if e.identified}
        widths = sum(math.isfinite(e.std) for e in found.estimates.values())
        off_name, off = worst(values, truth)
        rows.append(
            [
                name, f"{len(values)} of {len(truth)}", str(widths), f"{off:+.2f} ({off_name})",
                percent(error(values["b"], truth["b"])),
                fit(fits, "step1_1hz", ch.channel(ch.PISTON, 2)),
                could_not or DASH,
            ]
        )  # fmt: skip
    header = [
        "method", "values", "with interval", "worst error %", "error of b %",
        "FIT piston, STEP1 1 Hz", "failed to",
    ]  # fmt: skip
    return Section(
        "Summary of the methods",
        (Table("All methods on one bench", header, rows),),
    )


def _limits(done: Reproduction) -> str:
    ours = done.simultaneous.each.conditions["mechanical"].plain[1]
    best = done.each.conditions["mechanical"].plain[1]
    return f"keep the mechanical conditioning ({ours:.1f} against {best:.1f})"


def _broken(one: Simultaneous) -> str:
    broken = _unphysical(one)
    return f"stay possible: {', '.join(broken)} failed" if broken else DASH


def _search_limits(found: Identification) -> str:
    data = found.extra["search"]
    return f"see joint 1; give intervals; keep the state of {share(data):.0f} % of candidates"
