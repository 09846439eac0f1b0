"""The reproduced sections as tables beside the paper's: III, IV, conditioning, payload, figures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from analysis.report import paper
from analysis.report.plots.record_plots import comparison
from analysis.simulation.validate import RecordValidation
from rig.model import channels as ch
from rig.model.parameters import parameter_unit
from tests.studies.pages import Picture, Section, Table
from tests.studies.reproduction.bench import PAYLOAD, Reproduction
from tests.studies.reproduction.numbers import Experiments, oil_temperatures

DASH = "—"
KINDS = (ch.PISTON, ch.CAP, ch.ROD)
SHOWN_KINDS = {ch.PISTON: "piston", ch.CAP: "cap pressure", ch.ROD: "rod pressure"}


def scale_of(name: str) -> tuple[float, int, str]:
    """Return what a parameter is multiplied by to be shown, its decimals, and the unit."""
    if name == "b":
        return 1e-6, 1, "MPa"
    if name.startswith("C_"):
        return 1e7, 3, "1e-7 m³/(s·V·√Pa)"
    unit = parameter_unit(name).replace("*", "·").replace("^2", "²")
    return 1.0, 2 if name == "Fv1" else 3, unit


def shown(name: str, value: float | None, digits: int | None = None) -> str:
    """Write a parameter's SI value in its shown unit; a dash where there is none."""
    if value is None or not math.isfinite(value):
        return DASH
    scale, decimals, _ = scale_of(name)
    return f"{scale * value:.{decimals if digits is None else digits}f}"


def percent(value: float, digits: int = 2) -> str:
    """Write a signed percentage; a dash where there is none."""
    return f"{value:+.{digits}f}" if math.isfinite(value) else DASH


def error(value: float, truth: float) -> float:
    """Return the relative error [%]."""
    return 100.0 * (value / truth - 1.0)


def worst(values: Mapping[str, float], truth: Mapping[str, float]) -> tuple[str, float]:
    """Return the parameter furthest from the truth and its error [%]."""
    errors = {n: error(v, truth[n]) for n, v in values.items() if math.isfinite(v)}
    name = max(errors, key=lambda n: abs(errors[n]))
    return name, errors[name]


def means(each: Experiments) -> dict[str, float]:
    """Return the mean of every parameter over the experiments."""
    return {name: s.mean for name, s in each.spreads.items()}


def table_iii(done: Reproduction) -> Section:
    """Set min, mean, max and RSD of all parameters beside the paper's."""
    rows = []
    for name, ours in done.each.spreads.items():
        theirs = paper.TABLE_III[name]
        digits = 0 if name == "b" else 2
        rows.append(
            [
                name, scale_of(name)[2],
                *(shown(name, v, digits) for v in (theirs.low, theirs.mean, theirs.high)),
                f"{theirs.rsd:.2f}",
                *(shown(name, v) for v in (ours.low, ours.mean, ours.high)),
                f"{ours.rsd:.3f}",
                shown(name, done.runs.truth[name], digits),
                percent(error(ours.mean, done.runs.truth[name]), 3),
            ]
        )  # fmt: skip
    header = [
        "parameter", "unit", "paper min", "mean", "max", "RSD %",
        "here min", "mean", "max", "RSD %", "truth", "error of mean %",
    ]  # fmt: skip
    name, off = worst(means(done.each), done.runs.truth)
    largest = max(s.rsd for s in done.each.spreads.values())
    return Section(
        "Table III: the parameters",
        (
            f"{done.each.count} experiments, each identified separately from its three coupled "
            "steps. The bench's true parameters are the paper's means, so that the columns can be "
            "compared; the analysis does not know them; they are listed for the error of the mean "
            f"only. The largest error is that of {name}, {off:+.2f} %; the largest RSD here is "
            f"{largest:.2f} %, the paper's "
            f"{max(p.rsd for p in paper.TABLE_III.values()):.2f} %. The true b is stated for oil "
            f"at {done.rig.oil.temperature:g} °C; the oil of these records was at {_oil(done)} "
            "°C. A simulated bench does not wear, and its sensors have only the noise of their "
            "data sheet: the scatter is far below a real bench's.",
            Table(f"Table III, {done.each.count} experiments", header, rows),
            *_own_filter(done),
        ),
    )


def _oil(done: Reproduction) -> str:
    found = oil_temperatures(done.runs.steps).values()
    return f"{min(found):.1f} to {max(found):.1f}" if found else "an unknown number of"


def _own_filter(done: Reproduction) -> tuple[str, Table]:
    rows = []
    for name, one in done.paper_each.spreads.items():
        better = done.each.spreads[name]
        truth = done.runs.truth[name]
        rows.append(
            [
                name, f"{one.rsd:.3f}", percent(error(one.mean, truth)),
                f"{better.rsd:.3f}", percent(error(better.mean, truth), 3),
            ]
        )  # fmt: skip
    name, off = worst(means(done.paper_each), done.runs.truth)
    rsd = done.paper_each.spreads[name].rsd
    return (
        "**Small scatter is not accuracy.** The same records through the paper's own processing, a "
        "moving average of 20 samples (made zero-phase, or the channels would shift against each "
        f"other) and differences at every sample: {name} comes out {off:+.1f} % off with an RSD of "
        f"{rsd:.2f} %. Noise in the differentiated columns biases least squares the same way in "
        "every repeat, and no scatter shows it; `bramah identify` predicts it (check `noise bias`) "
        "and gives no number that rests on noise.",
        Table(
            "The paper's filter and this program's, on the same records",
            ["parameter", "paper's filter: RSD %", "error %", "here: RSD %", "error %"],
            rows,
        ),
    )


def conditioning(done: Reproduction) -> Section:
    """Set condition numbers, rows and the time to solve beside the paper's."""
    rows = []
    for family, theirs in paper.CONDITION.items():
        ours = done.each.conditions[family]
        own = done.paper_each.conditions[family]
        rows.append(
            [
                family, f"{theirs[0]} to {theirs[1]}", _span(ours.plain), _span(own.plain),
                _span(ours.scaled), str(paper.ROWS[family]), str(ours.rows), str(own.rows),
            ]
        )  # fmt: skip
    header = [
        "rows of", "paper", "here, plain SI", "paper's filter, plain SI", "here, columns scaled",
        "paper's rows", "rows here", "paper's filter",
    ]  # fmt: skip
    return Section(
        "Condition numbers, rows, time",
        (
            "The paper does not say how its matrices are scaled. With plain SI columns (1/b in "
            "1/Pa) the numbers come out in the paper's region; with columns of unit length, as "
            "`bramah identify` reports them, they measure the excitation independently of the "
            "units. One experiment each, least and largest over the experiments. Rows here are "
            "few because they are low-passed and decimated.",
            Table("Conditioning of one experiment", header, rows),
            f"To solve one experiment took {1e3 * done.each.solve_seconds:.0f} ms (median; with "
            f"every row of the paper's filter {1e3 * done.paper_each.solve_seconds:.0f} ms), all "
            f"{done.each.count} together {1e3 * done.coupled.solve_seconds:.0f} ms; the paper says "
            f"{paper.SOLVE_SECONDS} s on its computer.",
        ),
    )


def _span(ends: tuple[float, float]) -> str:
    return f"{ends[0]:.2f} to {ends[1]:.2f}"


def table_iv(done: Reproduction) -> Section:
    """Set FIT of the free run on new data beside the paper's, with Figs. 6 to 10."""
    measured = {r.step: r for r in done.validation}
    rows = []
    for cell in paper.TABLE_IV:
        result = measured[cell.step]
        fits = [result.fit[ch.channel(kind, cell.joint)] for kind in KINDS]
        theirs = [DASH] * 3 if cell.fit is None else [f"{v:.1f}" for v in cell.fit]
        rows.append(
            [cell.step, str(cell.joint), *theirs, *(f"{v:.1f}" for v in fits), _fate(result)]
        )
    kinds = [SHOWN_KINDS[kind] for kind in KINDS]
    header = ["record", "joint", *(f"paper {k}" for k in kinds), *(f"here {k}" for k in kinds)]
    if any(row[-1] for row in rows):
        header.append("what went wrong")
    else:
        rows = [row[:-1] for row in rows]
    return Section(
        "Table IV: validation on new data",
        (
            "FIT [%] of the identified model, run freely from the record's first sample under the "
            "measured spool. 3 Hz and both joints at once were never used for the fit. For both "
            "joints the paper shows figures and prints no numbers. The simulated bench has no "
            "effect that the model lacks, apart from the plant's more detailed physics, so FIT "
            "is far above that of a real machine; it evaluates the method, not the completeness "
            "of the model.",
            Table("Table IV, FIT %", header, rows),
            *(p for cell in paper.TABLE_IV if cell.figure for p in (_figure(done, cell),)),
        ),
    )


def _fate(result: RecordValidation) -> str:
    if result.failure:
        return result.failure
    return f"{result.outside} samples outside 0..supply" if result.outside else ""


def _figure(done: Reproduction, cell: paper.PaperFit) -> Picture:
    result = next(r for r in done.validation if r.step == cell.step)
    record = next(r for r in done.runs.judged.records if r.name == result.record)
    number = cell.figure.removeprefix("Fig. ")
    drawn = comparison(done.rig, result, record, cell.joint, f"f{number}")
    caption = (
        f"The paper's {cell.figure} here: {cell.step}, joint {cell.joint}, measured (black) "
        "and model (red)"
    )
    return Picture(f"fig{number}.svg", str(drawn), caption)


def payload(done: Reproduction) -> Section:
    """Say which parameters respond to the payload and which stay."""
    rows = []
    for name, r in done.payload.items():
        digits = scale_of(name)[1]
        rows.append(
            [
                name, scale_of(name)[2], shown(name, r.before), shown(name, r.after),
                f"{scale_of(name)[0] * r.change:+.{digits}f}",
                f"{scale_of(name)[0] * r.expected:+.{digits}f}" if r.expected else "0",
                f"{scale_of(name)[0] * r.half_width:.{digits + 1}f}",
                "responds" if r.responds else "stays",
                "yes" if r.as_expected else "NO",
            ]
        )  # fmt: skip
    header = [
        "parameter", "unit", "without", f"with {PAYLOAD:g} kg", "change", "rigid bodies", "± 95 %",
        "", "as expected",
    ]  # fmt: skip
    moved = [name for name, r in done.payload.items() if r.responds]
    stayed = [name for name, r in done.payload.items() if not r.responds]
    M2 = done.payload["M2"]
    return Section(
        f"Payload: {PAYLOAD:g} kg at the tip",
        (
            f"A second bench of the same machine whose scenario file adds {PAYLOAD:g} kg at the "
            f"tip, {done.scale.payload_repeats} repeats, another seed. A point mass adds m·l_i·l_j "
            "to R_ij and m·l_i to W_i, so to M1 m·(l1² + l2²), to M2 m·l2², to R12 m·l1·l2. "
            f"**Responding** (by more than 1 %): {_list(moved)}. **Staying**: {_list(stayed)}.",
            Table("Parameters without and with the payload", header, rows),
            "The paper says that only R12, W1 and W2 respond and prints a new M2 of 12.21 kg·m². "
            "This contradicts rigid-body mechanics: the same mass that changes R12 changes M1 and "
            "M2, and "
            f"{PAYLOAD:g} kg at 0.5 m add {M2.expected:.3f} kg·m² to M2, not eleven. Here M2 goes "
            f"from {M2.before:.3f} to {M2.after:.3f} kg·m².",
        ),
    )


def _list(names: Sequence[str]) -> str:
    return " ".join(names) or "none"
