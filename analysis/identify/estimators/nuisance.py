"""Fit small effects that the model leaves out, as additional (nuisance) columns of the rows.

They shift parameters by more than their scatter, so that intervals without them would be wrong.
Each is one column of the fluid rows, or of an electric joint's torque rows; its coefficient is
estimated with the parameters but is not one of them.

Oil temperature. The oil's temperature, and with it the bulk modulus, changes between records; one b
for all records would be that of their mean temperature, and the gains of the steps would shift.
Here b is that of the rig's nominal temperature T0:
 1/b becomes 1/b(T0) + kappa (T - T0), kappa = - alpha / b, alpha = d ln b / dT.
Known beforehand: alpha lies between that of pure mineral oil, 10^(0.0023 (20 - T)) or -0.0053 per
kelvin (Hodges, Hydraulic Fluids, 1996, ch. 7), and that of hoses and lines alone, about 0.

Laminar transition. An orifice's flow is C u dp / (dp^2 + dp_t^2)^(1/4) (as in Borutzky, Barnard
and Thoma, 2002, and the orifices of common simulation libraries), to first order
 C u sqrt(dp) (1 - dp_t^2 / (4 dp^2)),
a little less than sqrt(dp) everywhere: at drops of a few MPa this looks like a smaller C. C is then
that of fully turbulent flow. Known beforehand: dp_t is of the order of 0.1 MPa or below.

Path between samples. A command that is held between samples makes the spool's path bend at every
renewal: the path interpolated between samples leads or lags the true one by a part of the interval
T, to first order C (u + f T du/dt) sqrt(dp), one f for each valve. A flow proportional to du/dt
resembles compression, so that it would shift b. Known beforehand: |f| is of the order of 0.05 or
below. An electric drive's current does the same to a joint's torque, k (i + f T di/dt), which would
shift viscous friction.

Prior knowledge enters as further rows of the estimating equations. A prior observation 0 = h'beta
with standard deviation s is one more row with the weight 1 / s^2, where the other rows have the
weight 1 / sigma^2: A becomes A + rho h h', rho = sigma^2 / s^2, and beta and A^-1 follow by the
formula of Sherman and Morrison. sigma^2 is the variance that the rows' residuals have for h, V =
sigma^2 A^-1 in its direction: residuals of neighbouring rows correlate, so that their mean square
would be too small. It is that of a normal distribution with the 95 % interval of the repeats'
scatter, and at least that of residuals without correlation: of two repeats, the scatter alone is
often a tenth of the true one, and a slope over a fraction of a kelvin would outweigh all that is
known of oils. The same rows belong to least squares and to instruments: what only a prior
determines, such as the slope over a temperature that hardly varied, would otherwise be left to the
noise there. Source: Theil and Goldberger (1961), On Pure and Mixed Statistical Estimation in
Economics, International Economic Review 2.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from analysis.identify.estimators.covariance import CovarianceParts, spread
from analysis.identify.estimators.equations import EquationFit, pieces
from analysis.identify.settings import IDENTIFY
from analysis.signals.conditioning import Signals
from analysis.terms.base import Coefficient, Columns, Term, Used, equation
from analysis.terms.hydraulics import Compressibility, root_of_drop
from rig.model import channels as ch
from rig.model.parameters import gain_names
from rig.model.records import Run
from rig.model.rig import Rig

Array = NDArray[np.float64]
Gains = tuple[tuple[str, float], ...]
Law = Callable[[Array], Array]

KAPPA, TAU = "1/b per kelvin", "transition pressure squared"
BETWEEN = "spool's path between samples at joint "
DRIVE_BETWEEN = "drive's path between samples at joint "


@dataclass(frozen=True)
class BulkTemperature(Term):
    """- V dp/dt (T - T0) in the flow rows: the temperature part of 1/b.

    T0 is `reference` [degC], the rig's nominal temperature where it is None.
    """

    name: ClassVar[str] = "bulk_temperature_nuisance"
    reference: float | None = None

    def coefficients(self, rig: Rig) -> tuple[Coefficient, ...]:
        """Return kappa [1/(Pa K)]."""
        return (Coefficient(KAPPA, "Pa^-1*K^-1", "fluid"),)

    def columns(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Columns:
        """Return the column of each chamber."""
        reference = rig.oil.temperature if self.reference is None else self.reference
        kelvin = signals.temperature - reference
        compression = Compressibility().columns(rig, signals, shape)
        return {e: {KAPPA: columns["b"] * kelvin} for e, columns in compression.items()}


@dataclass(frozen=True)
class LaminarTransition(Term):
    """- (C u / 4) dp^(-3/2) on every edge, with the gains C of a first solution."""

    name: ClassVar[str] = "laminar_transition_nuisance"
    gains: Gains = ()

    def coefficients(self, rig: Rig) -> tuple[Coefficient, ...]:
        """Return dp_t^2 [Pa^2]."""
        return (Coefficient(TAU, "Pa^2", "fluid"),)

    def columns(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Columns:
        """Return the column of each chamber."""
        out: Columns = {}
        for i in signals.excited_joints:
            u = signals.u[:, i]
            openings = np.maximum(u, 0.0), np.minimum(u, 0.0)
            out |= _at_edges(signals, i, self.gains, TAU, openings, _transition)
        return out


@dataclass(frozen=True)
class SpoolPath(Term):
    """C T du/dt sqrt(dp) of every edge of joint `joint` (0-based), with first gains C."""

    name: ClassVar[str] = "spool_path_nuisance"
    gains: Gains = ()
    joint: int = 0

    def coefficients(self, rig: Rig) -> tuple[Coefficient, ...]:
        """Return f, in sample intervals."""
        return (Coefficient(f"{BETWEEN}{self.joint + 1}", "", "fluid"),)

    def columns(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Columns:
        """Return the column of each chamber; none where the joint is not excited."""
        i = self.joint
        if i not in signals.excited_joints:
            return {}
        u = signals.u[:, i]
        step = np.gradient(u)  # T du/dt
        openings = np.where(u > 0, step, 0.0), np.where(u < 0, step, 0.0)
        return _at_edges(signals, i, self.gains, f"{BETWEEN}{i + 1}", openings, root_of_drop)


@dataclass(frozen=True)
class DrivePath(Term):
    """- k T di/dt of the drive of electric joint `joint` (0-based), beside its torque k i."""

    name: ClassVar[str] = "drive_path_nuisance"
    joint: int = 0

    def coefficients(self, rig: Rig) -> tuple[Coefficient, ...]:
        """Return f, in sample intervals."""
        return (Coefficient(f"{DRIVE_BETWEEN}{self.joint + 1}", "", "mechanical"),)

    def columns(self, rig: Rig, signals: Signals, shape: Sequence[float]) -> Columns:
        """Return the column of the joint's torque rows; none where it is not excited."""
        i = self.joint
        if i not in signals.excited_joints:
            return {}
        column = -rig.drive_gains[i] * np.gradient(signals.u[:, i])
        return {equation("torque", i): {f"{DRIVE_BETWEEN}{i + 1}": column}}


def _at_edges(
    signals: Signals, i: int, gains: Gains, name: str, openings: tuple[Array, Array], law: Law
) -> Columns:
    """Return the column `name` of joint i's chambers: gain times `law` of the drop times opening.

    `openings` are those of the edges that are open for u > 0 and for u < 0.
    """
    C, (positive, negative) = dict(gains), openings
    pp, pm, mp, mm = (C.get(gain, 0.0) for gain in gain_names(i + 1))
    p_s, p_t = signals.p_s, signals.p_tank
    cap, rod = signals.p_cap[:, i], signals.p_rod[:, i]
    in_cap = pp * law(p_s - cap) * positive + pm * law(cap - p_t) * negative
    in_rod = -mp * law(rod - p_t) * positive - mm * law(p_s - rod) * negative
    return {equation("flow_cap", i): {name: in_cap}, equation("flow_rod", i): {name: in_rod}}


def _transition(drop: Array) -> Array:
    """Return - dp^(-3/2) / 4 of drops (n,) [Pa]; constant below `least_drop`."""
    limited = np.maximum(drop, IDENTIFY.least_drop * IDENTIFY.transition_drop)
    return np.asarray(-0.25 / (limited * np.sqrt(limited)))


@dataclass(frozen=True)
class Prior:
    """A prior observation 0 = h'beta with standard deviation `std`, of column `name`."""

    name: str
    h: Array
    std: float


def nuisance_terms(
    terms: Sequence[Used], runs: Sequence[Run], values: Mapping[str, float]
) -> tuple[Used, ...]:
    """Return the nuisances for a model of `terms`; `values` are first estimates by name.

    The transition belongs to a model with orifices alone: further flow terms would be correlated
    with it.
    """
    names = {used.term.name for used in terms}
    rig = runs[0].rig
    if rig.electric:
        return sample_paths(rig, range(len(rig.joints)), values)
    nuisances: list[Used] = []
    measured = all(ch.TEMPERATURE in r.channels for run in runs for r in run.records)
    if "compressibility" in names and measured and np.isfinite(values.get("b", np.nan)):
        nuisances.append(Used(BulkTemperature()))
    gains = {n: v for n, v in values.items() if n.startswith("C_") and np.isfinite(v)}
    if "orifice" in names and gains:
        nuisances.append(Used(LaminarTransition(gains=tuple(gains.items()))))
        joints = sorted({int(n.rsplit("_", 1)[1]) - 1 for n in gains})
        nuisances += sample_paths(rig, joints, gains)
    return tuple(nuisances)


def sample_paths(rig: Rig, joints: Iterable[int], values: Mapping[str, float]) -> tuple[Used, ...]:
    """Return the nuisance of the path between samples for each of `joints` (0-based).

    A spool's needs the gains among `values`, first estimates by name; without them it has none.
    """
    if rig.electric:
        return tuple(Used(DrivePath(joint=i)) for i in joints)
    gains = tuple((n, v) for n, v in values.items() if n.startswith("C_") and np.isfinite(v))
    return tuple(Used(SpoolPath(gains=gains, joint=i)) for i in joints) if gains else ()


def priors(names: Sequence[str], value: Array) -> list[Prior]:
    """Return the prior knowledge of the nuisances among the columns `names` (k,)."""
    unit = np.eye(len(names))
    out = []
    if KAPPA in names and "b" in names:
        b = names.index("b")
        h = unit[names.index(KAPPA)] + IDENTIFY.bulk_slope * unit[b]
        out.append(Prior(KAPPA, h, IDENTIFY.bulk_slope_std * abs(float(value[b]))))
    if TAU in names:
        out.append(Prior(TAU, unit[names.index(TAU)], IDENTIFY.transition_drop**2))
    for name, h in zip(names, unit, strict=True):
        if name.startswith((BETWEEN, DRIVE_BETWEEN)):
            out.append(Prior(name, h, IDENTIFY.path_between_samples))
    return out


def variance_by_rows(fit: EquationFit, error: CovarianceParts, h: Array) -> float:
    """Return the variance of h'beta, h (k,): that of the 95 % interval by the spread `error`.

    It is at least that by residuals without correlation (White, 1980): repeats may happen to agree.
    """
    influence = fit.inverse.T @ h
    squares = (
        float(np.sum(((z @ influence) * weight * e) ** 2))
        for z, weight, e in zip(fit.Z, fit.w, fit.residuals(), strict=True)
    )
    return max(float(h @ error.normal @ h), sum(squares))


def implausible(prior: Prior, fit: EquationFit, error: CovarianceParts) -> bool:
    """Return whether the data contradict prior knowledge, as another effect in the column does."""
    h, deviations = prior.h, IDENTIFY.implausible_deviations
    of_both = deviations**2 * (prior.std**2 + float(h @ error.covariance @ h))
    of_interval = 2.0**2 * variance_by_rows(fit, error, h)
    return bool((h @ fit.beta) ** 2 > max(of_both, of_interval))


@dataclass(frozen=True)
class PriorRow:
    """A prior observation 0 = h'beta, h (k,), its standard deviation and its weight rho."""

    h: Array
    std: float
    weight: float


def prior_rows(fit: EquationFit, priors: Sequence[Prior]) -> tuple[PriorRow, ...]:
    """Return the rows of prior observations beside those of a fit of least squares.

    A prior has no row where the columns that it concerns are zero in all rows of the fit.
    """
    rows: list[PriorRow] = []
    for prior in priors:
        joined = with_prior_rows(fit, rows)
        share = float(prior.h @ joined.inverse @ prior.h)
        if share > 0.0:
            variance = variance_by_rows(joined, spread_with_priors(joined, rows), prior.h)
            rows.append(PriorRow(prior.h, prior.std, variance / share / prior.std**2))
    return tuple(rows)


def with_prior_rows(fit: EquationFit, rows: Sequence[PriorRow]) -> EquationFit:
    """Return the solution (k,) and A^-1 (k, k) of a fit's rows and prior rows together."""
    beta, inverse = fit.beta, fit.inverse
    for row in rows:
        if row.weight > 0.0:
            gain = inverse @ row.h / (1.0 / row.weight + row.h @ inverse @ row.h)
            beta = beta - gain * (row.h @ beta)
            inverse = inverse - np.outer(gain, row.h @ inverse)
    return replace(fit, beta=beta, inverse=inverse)


def spread_with_priors(fit: EquationFit, rows: Sequence[PriorRow]) -> CovarianceParts:
    """Return the spread of a fit joined with prior rows: scatter of its rows plus the priors' part.

    The priors' part of a variance counts as known: it has no part in Student's t.
    """
    of_rows = spread([pieces(fit), pieces(fit, "level")], fit.inverse)
    influence = [row.weight * row.std * (fit.inverse @ row.h) for row in rows]
    known = sum((np.outer(u, u) for u in influence), np.zeros_like(of_rows.covariance))
    scatter = np.diag(of_rows.covariance)
    with np.errstate(divide="ignore", invalid="ignore"):
        grown = np.where(scatter > 0, np.minimum(1.0 + np.diag(known) / scatter, 1e3), 1.0)
    systematic = np.minimum(of_rows.systematic, 1.0) / grown
    return CovarianceParts(of_rows.covariance + known, of_rows.dof * grown**2, systematic)
