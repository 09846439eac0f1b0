"""Every effect of the catalogue found on a simulated bench that has it: sizes, residuals, pictures.

The bench's form of each effect is the simulator's own (LuGre, rounded edges, dissolving air ...).
Trained on one record per step of the multisine protocol; judged on another draw of it at seven
tenths of the amplitude.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from analysis.effects.base import Effect, Shape, ordered, shape_values
from analysis.regression.rows import Filtering, Rows, default_filtering, record_rows
from analysis.report.plots import style
from analysis.report.plots.trace_plots import axis
from analysis.signals.conditioning import Signals, condition
from analysis.terms import baseline, make
from analysis.terms.base import FAMILIES, Used, family_of
from hil_sim.scenario.file import parse_scenario
from protocols.files.plan import Overrides
from rig.model.rig import Rig
from tests.studies.direct_bench import simulated_run
from tests.studies.pages import markdown_table

Array = NDArray[np.float64]
PROTOCOL: Final = "lock-and-excite-multisine"
BINS: Final = 40
SEARCH: Final = 50  # looks at a shape after the grid

# place (the analysis's), what the scenario says beside the name, the sizes to be found
Example = tuple[str, str, str, Mapping[str, float]]
EXAMPLES: Final[tuple[Example, ...]] = (
    ("coulomb_friction", "joint 2", "where: joint 2, force: 80 N", {"Fc2": 80.0}),
    (
        "stribeck_friction", "joint 2", "where: joint 2, force: 120 N, speed: 30 mm/s",
        {"Fs2": 120.0, "v_stribeck_2": 0.03},
    ),
    (
        "asymmetric_friction", "joint 2", "where: joint 2, extending: 100 N, retracting: 50 N",
        {"F_ext_2": 100.0, "F_ret_2": 50.0},
    ),
    (
        "pressure_dependent_friction", "joint 2", "where: joint 2, coefficient: 1e-5 N/Pa",
        {"k_friction_2": 1e-5},
    ),
    (
        "asymmetric_viscous_friction", "joint 2",
        "where: joint 2, extending: 300 N*s/m, retracting: 50 N*s/m",
        {"c_ext_2": 300.0, "c_ret_2": 50.0},
    ),
    (
        "periodic_disturbance", "joint 2", "where: joint 2, torque: 3 N*m, frequency: 7 Hz",
        {"frequency_2": 7.0},
    ),
    ("base_inclination", "bench", "angle: 3 deg", {"inclination": np.deg2rad(3.0)}),
    ("joint_spring", "joint 2", "where: joint 2, stiffness: 30 N*m/rad", {"k_spring_2": 30.0}),
    ("torque_offset", "joint 2", "where: joint 2, torque: 5 N*m", {"T_offset_2": 5.0}),
    (
        "valve_deadband", "joint 2", "where: joint 2, width: 5 mV, astern: 8 mV",
        {"w_ahead_2": 5e-3, "w_astern_2": 8e-3},
    ),
    ("spool_offset", "joint 1", "where: joint 1, voltage: 3 mV", {"u_null_1": 3e-3}),
    ("underlap_leakage", "joint 2", "where: joint 2, width: 5 mV", {"w_underlap_2": 5e-3}),
    ("laminar_orifice", "bench", "transition: 1 MPa", {"dp_laminar": 1e6}),
    ("spool_lag", "joint 2", "where: joint 2, time: 3 ms", {"tau_spool_2": 3e-3}),
    ("spool_hysteresis", "joint 2", "where: joint 2, width: 4 mV", {"w_hysteresis_2": 4e-3}),
    ("return_line", "bench", "drop: 1.5 MPa", {"dp_return": 1.5e6}),
    (
        "sensor_lag", "joint 1 cap", "channel: cap_pressure_1, time: 3 ms",
        {"lag_cap_pressure_1": 3e-3},
    ),
    (
        "sensor_crosstalk", "joint 2 cap", "channel: cap_pressure_2, share: 0.05",
        {"crosstalk_cap_pressure_2": 0.05},
    ),
    (
        "internal_leakage", "joint 1", "where: joint 1, conductance: 2e-12 m^3/(s*Pa)",
        {"c_internal_1": 2e-12},
    ),
    (
        "external_leakage", "joint 1 rod", "where: joint 1 rod, conductance: 2e-12 m^3/(s*Pa)",
        {"c_external_1_rod": 2e-12},
    ),
    ("supply_sag", "bench", "line_drop: 1 MPa", {"dp_supply": 1e6}),
    ("tank_pressure", "bench", "pressure: 0.4 MPa", {"p_tank": 4e5}),
    ("entrained_air", "bench", "fraction: 0.02", {"alpha_air": 0.02}),
    ("dead_volume", "joint 1 cap", "where: joint 1 cap, volume: 50 cm^3", {"V_dead_1_cap": 5e-5}),
    (
        "channel_delay", "joint 1 piston", "channel: piston_1, time: 3 ms",
        {"delay_piston_1": 3e-3},
    ),
    (
        "sensor_gain", "joint 2 cap", "channel: cap_pressure_2, gain: 1.03",
        {"gain_cap_pressure_2": 1.03},
    ),
    (
        "sensor_offset", "joint 2 rod", "channel: rod_pressure_2, offset: 0.1 MPa",
        {"offset_rod_pressure_2": 1e5},
    ),
)  # fmt: skip


@dataclass(frozen=True)
class Fit:
    """The rows' coefficients under a set of terms, and the residual's RMS by equation."""

    terms: tuple[Used, ...]
    values: Mapping[str, float]
    rms: Mapping[str, float]


class Bench:
    """Conditioned records of one simulated experiment."""

    def __init__(self, rig: Rig, scenario: str, seed: int, scale: float) -> None:
        change = Overrides(repeats=1, amplitude_scale=scale, seed=seed)
        said = parse_scenario(scenario, "example") if scenario else None
        run, self.truth = simulated_run(rig, PROTOCOL, seed, said, change)
        self.rig = rig
        self.records: list[tuple[Signals, Filtering]] = []
        for record in run.records:
            filters = default_filtering(record)
            self.records.append((condition(rig, record, filters.channels), filters))

    def rows(self, terms: Sequence[Used]) -> list[list[Rows]]:
        """Return the rows of every record."""
        return [list(record_rows(self.rig, terms, s, f).values()) for s, f in self.records]

    def solved(self, terms: Sequence[Used]) -> Fit:
        """Return least squares of all records."""
        rows = list(itertools.chain.from_iterable(self.rows(terms)))
        values: dict[str, float] = {}
        for family in FAMILIES:
            here = [r for r in rows if family_of(r.equation) == family]
            X, y = np.concatenate([r.matrix for r in here]), np.concatenate([r.rhs for r in here])
            scale = np.linalg.norm(X, axis=0) + 1e-300
            beta = np.linalg.lstsq(X / scale, y, rcond=1e-9)[0] / scale
            values |= dict(zip(here[0].names, map(float, beta), strict=True))
        return Fit(tuple(terms), values, self.rms(terms, values))

    def rms(self, terms: Sequence[Used], values: Mapping[str, float]) -> dict[str, float]:
        """Return the residual's RMS by equation under given coefficients."""
        left: dict[str, list[Array]] = {}
        for r in itertools.chain.from_iterable(self.rows(terms)):
            left.setdefault(r.equation, []).append(_left(r, values))
        return {name: float(np.sqrt(np.mean(np.concatenate(e) ** 2))) for name, e in left.items()}


def _left(rows: Rows, values: Mapping[str, float]) -> Array:
    return np.asarray(rows.rhs - rows.matrix @ np.array([values[n] for n in rows.names]))


def fitted(bench: Bench, effect: Effect, floor: Mapping[str, float]) -> Fit:
    """Return the baseline with the effect, its shapes searched (variable projection)."""
    base = tuple(Used(term) for term in baseline())

    def solved(shape: Sequence[float]) -> Fit:
        return bench.solved(ordered((*base, Used(effect, tuple(shape)))))

    def cost(shape: Sequence[float]) -> float:
        fit = solved(shape)
        return sum((fit.rms[name] / floor[name]) ** 2 for name in floor)

    return solved(searched(effect.shapes(bench.rig), cost, SEARCH))


def searched(
    shapes: Sequence[Shape], cost: Callable[[Sequence[float]], float], most: int
) -> tuple[float, ...]:
    """Return the shape of least cost, from the grid on by at most `most` looks; details last."""

    def nearby(start: Sequence[float]) -> tuple[float, ...]:
        low, high = np.array([(s.low, s.high) for s in shapes[: len(start)]]).T
        size = np.where(np.array(start) != 0, 0.3 * np.abs(start), 0.02 * (high - low))
        simplex = np.vstack((np.zeros(len(start)), np.eye(len(start))))

        def at(a: Array) -> tuple[float, ...]:
            return tuple(map(float, np.clip(start + size * a, low, high)))

        found = minimize(
            lambda a: cost(at(a)), simplex[0], method="Nelder-Mead",
            options={"initial_simplex": simplex, "maxfev": most, "xatol": 0.01},
        )  # fmt: skip
        return at(found.x)

    if not shapes:
        return ()
    details = tuple(s.middle for s in shapes if s.detail)
    best = min(itertools.product(*(s.grid for s in shapes if not s.detail)), key=cost)
    best = nearby(best) if best else best
    return min(best, nearby((*best, *details)), key=cost) if details else best


@dataclass(frozen=True)
class Outcome:
    """One example: parameters (true, found), held-out residual over the floor, its picture."""

    effect: Effect
    sizes: Mapping[str, tuple[float, float]]
    equation: str
    before: float
    after: float
    abscissa: Array
    left: tuple[Array, Array]
    label: str


def study(rig: Rig, seed: int, only: Sequence[str], say: Callable[[str], None]) -> list[Outcome]:
    """Return the outcome of every example, or of those named."""
    base = tuple(Used(term) for term in baseline())
    clean = Bench(rig, "", seed, 1.0)
    floor = clean.solved(base).rms
    judged = Bench(rig, "", seed + 10, 0.7).rms(base, clean.solved(base).values)
    out = []
    for name, where, said, sizes in EXAMPLES:
        if only and name not in only:
            continue
        say(f"{name} at {where}")
        scenario = f"effects: [{{name: {name}, {said}}}]"
        train, held_out = Bench(rig, scenario, seed, 1.0), Bench(rig, scenario, seed + 10, 0.7)
        out.append(_outcome(make(name, where), train, held_out, base, floor, judged, sizes))  # type: ignore[arg-type]
    return out


def _outcome(
    effect: Effect, train: Bench, held_out: Bench, base: tuple[Used, ...],
    floor: Mapping[str, float], judged: Mapping[str, float], sizes: Mapping[str, float],
) -> Outcome:  # fmt: skip
    plain, fit = train.solved(base), fitted(train, effect, floor)
    before, after = held_out.rms(base, plain.values), held_out.rms(fit.terms, fit.values)
    used = next(u for u in fit.terms if u.term == effect)
    found = {**fit.values, **shape_values(train.rig, used)}
    worst = max(
        (name for name in judged if name in effect.abscissa(train.rig, train.records[0][0])),
        key=lambda name: before[name] / judged[name],
    )
    abscissa, old, new = _picture(train, effect, worst, plain, fit)
    label, scale = axis(train.rig, effect.plotted())
    return Outcome(
        effect, {n: (v, found[n]) for n, v in sizes.items()}, worst,
        before[worst] / judged[worst], after[worst] / judged[worst], scale * abscissa, (old, new),
        label,
    )  # fmt: skip


def _picture(
    bench: Bench, effect: Effect, equation: str, plain: Fit, fit: Fit
) -> tuple[Array, Array, Array]:
    """Return the effect's variable at the rows' instants and the residual before and after."""
    x, old, new = [], [], []
    for (signals, _), first, second in zip(
        bench.records, bench.rows(plain.terms), bench.rows(fit.terms), strict=True
    ):
        a = next((r for r in first if r.equation == equation), None)
        b = next((r for r in second if r.equation == equation), None)
        if a is None or b is None:
            continue
        _, here, there = np.intersect1d(a.time, b.time, return_indices=True)
        variable = effect.abscissa(bench.rig, signals)[equation]
        x.append(np.interp(a.time[here], signals.t, variable))
        old.append(_left(a, plain.values)[here])
        new.append(_left(b, fit.values)[there])
    return np.concatenate(x), np.concatenate(old), np.concatenate(new)


def table(outcomes: Sequence[Outcome]) -> str:
    """Return the Markdown table of sizes and residuals."""
    header = ("effect", "where", "parameter", "true", "found", "row", "before", "after")
    rows = []
    for o in outcomes:
        for k, (name, (true, found)) in enumerate(o.sizes.items()):
            ends = (f"`{o.equation}`", f"{o.before:.1f}", f"{o.after:.2f}") if k == 0 else ("",) * 3
            who = (f"`{o.effect.name}`", f"`{o.effect.place}`") if k == 0 else ("", "")
            rows.append((*who, f"`{name}`", f"{true:.4g}", f"{found:.4g}", *ends))
    return "\n".join(markdown_table(header, rows)) + "\n"


def figures(outcomes: Sequence[Outcome]) -> dict[str, str]:
    """Return one SVG per family: residual against the effect's variable, before and after."""
    out = {}
    families = dict.fromkeys(o.effect.family for o in outcomes)
    for family in families:
        here = [o for o in outcomes if o.effect.family == family]
        with style.style():
            rows = -(-len(here) // 2)
            made = style.figure(0.4 + 1.75 * rows, 7.2)
            for k, o in enumerate(here):
                _panel(made.add_subplot(rows, 2, k + 1), o)
            made.tight_layout(pad=0.6)
            text = str(style.svg(made, family, f"signatures of the {family} effects"))
        out[family] = text.replace("<svg ", '<svg xmlns="http://www.w3.org/2000/svg" ', 1)
    return out


def _panel(axes, o: Outcome) -> None:  # type: ignore[no-untyped-def]
    edges = np.unique(np.quantile(o.abscissa, np.linspace(0, 1, BINS + 1)))
    at = np.clip(np.searchsorted(edges, o.abscissa, side="right") - 1, 0, len(edges) - 2)
    count = np.maximum(np.bincount(at, minlength=len(edges) - 1), 1)
    middle = np.bincount(at, o.abscissa, len(edges) - 1) / count
    for left, colour, width in zip(o.left, (style.GREY, style.MODEL), (2.2, 1.2), strict=True):
        axes.plot(middle, np.bincount(at, left, len(edges) - 1) / count, color=colour, lw=width)
    unit = "N m" if o.equation.startswith("torque") else "m^3/s"
    axes.set_title(f"{o.effect.name}, {o.equation} [{unit}]")
    axes.set_xlabel(o.label)
