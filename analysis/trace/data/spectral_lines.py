"""Spectral lines: at which frequencies a residual repeats, and whether its cause is symmetric.

A multisine of odd lines leaves all even lines and some odd ones empty. A linear cause answers on
the excited lines alone, a symmetric nonlinearity (dry friction, a dead band) also on the empty odd
lines, an asymmetric one (tank pressure, friction that differs by direction) on the even lines
(Pintelon and Schoukens, System Identification: A Frequency Domain Approach, 2012, ch. 4). With
A_k,r the rms amplitude of line k in repeat r,
 repeatable_k = |mean_r A_k,r|^2 - noise_k / n,   noise_k = var_r A_k,r (ddof 1).
Rows at a record's ends and masked ones are absent. Half the sum and half the difference of samples
half a period apart contain the even and the odd lines alone; in each the lines are fitted by least
squares. The linkage and the two piston areas put any motion slightly on empty lines: the piston's
own velocity shows how much of a linear cause lies off the excited lines.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.regression.conditioned import ConditionedRecord
from analysis.regression.rows import Rows, lines_cutoff
from analysis.terms.base import joint_of
from analysis.trace.data.conditioned_record import filtered
from analysis.trace.data.noise_floor import Group
from analysis.trace.data.regression_data import RegressionData, Segment
from analysis.trace.settings import DATA

Array = NDArray[np.float64]

CONSTANT, EXCITED, ODD, EVEN = "constant", "excited", "odd", "even"
KINDS = (CONSTANT, EXCITED, ODD, EVEN)
WORDS = {
    CONSTANT: "constant", EXCITED: "on excited lines", ODD: "on empty odd lines",
    EVEN: "on even lines",
}  # fmt: skip


@dataclass(frozen=True)
class SpectralLines:
    """The lines 0..K of one equation's residual in one group of records, powers (rms squared, SI).

    `frequency` [Hz], `repeatable` power under the baseline and `noise` power of one repeat, each
    (K + 1,); `after` is the repeatable power under the final model; `excited` marks the excited
    lines. `shares` are the shares of `repeatable` by kind of line, `shares_after` those of `after`,
    `velocity_shares` those of the joint's velocity. `above_noise` is the repeatable rms under the
    baseline over the noise, both of the whole residual.
    """

    group: Group
    equation: str
    frequency: Array
    repeatable: Array
    noise: Array
    after: Array
    excited: NDArray[np.bool_]
    shares: Mapping[str, float]
    shares_after: Mapping[str, float]
    velocity_shares: Mapping[str, float]
    above_noise: float

    @property
    def above_noise_after(self) -> float:
        """Repeatable rms under the final model over the noise rms of one repeat, of all lines."""
        return float(np.sqrt(max(0.0, self.after.sum()) / max(float(self.noise.sum()), 1e-300)))

    @property
    def text(self) -> str:
        """On which kinds of lines the residual repeats, and what that means, in words."""
        where = ", ".join(
            f"{100 * share:.0f} % {WORDS[kind]}"
            for kind, share in self.shares.items()
            if share >= DATA.noted_line_share
        )
        return f"{self.equation} in {self.group[1]}: {where or 'no line'}: {self.meaning}"

    @property
    def meaning(self) -> str:
        """The cause that the lines of the residual under the baseline show."""
        return meaning(self.shares, self.velocity_shares)

    @property
    def meaning_after(self) -> str:
        """The cause that the lines of the residual under the final model show."""
        return meaning(self.shares_after, self.velocity_shares)


def meaning(shares: Mapping[str, float], velocity_shares: Mapping[str, float]) -> str:
    """Return the cause in words, from the shares by kind of line of residual and velocity."""
    if not any(shares.values()):
        return "not above the noise"
    moving = 1.0 - shares[CONSTANT]
    if moving < DATA.asymmetric_share:
        return "constant"
    meanings = []
    for kind, threshold, word in (
        (EVEN, DATA.asymmetric_share, "asymmetric"),
        (ODD, DATA.symmetric_share, "a symmetric nonlinearity"),
    ):
        share = shares[kind] / moving
        if share > threshold and share > DATA.velocity_ratio * velocity_shares[kind]:
            meanings.append((share, word))
    if not meanings:
        return "linear in the motion"
    meanings.sort(reverse=True)
    if len(meanings) == 2 and meanings[1][0] < 0.5 * meanings[0][0]:
        return f"mostly {meanings[0][1]}"
    return " and ".join(word for _, word in meanings)


def spectral_lines(data: RegressionData, after: Array) -> tuple[SpectralLines, ...]:
    """Return the lines of every equation and group excited by odd lines, largest residual first.

    `after` (M,) is the averaged whitened residual of the final model.
    """
    ratios = {(f.group, f.equation): f.ratio for f in data.floors}
    out = []
    for s in data.segments:
        conditioned, rows = data.source(s)
        record = conditioned.record
        if record.period and record.lines and all(k % 2 for k in record.lines):
            residual = data.residual[: s.repeats, s.where] * s.noise
            final_residual = after[s.where] * s.noise / np.sqrt(s.repeats)
            residuals, ratio = np.vstack((residual, final_residual)), ratios[s.group, s.equation]
            of_segment = _segment_lines(s, conditioned, rows, residuals, ratio)
            if of_segment is not None:
                out.append(of_segment)
    return tuple(sorted(out, key=lambda equation_lines: -equation_lines.above_noise))


def _segment_lines(
    s: Segment, conditioned: ConditionedRecord, rows: Rows, residuals: Array, above_noise: float
) -> SpectralLines | None:
    """Return the lines of residuals (repeats + 1, m) [SI]; the last one is of the final model."""
    record = conditioned.record
    highest = max(record.lines)
    step = conditioned.filtering.step
    period_rows = record.period // step
    place = np.rint((rows.time - rows.time[0]) * record.sample_rate / step)
    pairs = _half_period_pairs(place.astype(np.int64), period_rows)
    base_frequency = record.sample_rate / record.period
    highest_line = DATA.line_band * lines_cutoff(record) / base_frequency
    K = int(min([highest_line, *(DATA.lines_per_pair * len(p) for p in pairs)]))
    if not pairs or highest > K:
        return None
    joint = joint_of(s.equation)
    velocity = filtered({"v": conditioned.signals.sd[:, joint]}, conditioned, rows)["v"]
    series = np.vstack((residuals, velocity))
    spectra = np.stack([spectrum(place[p[:, 0]] / period_rows, series[:, p], K) for p in pairs])
    of_periods = spectra[:, :-2].reshape(-1, K + 1)  # periods of one repeat are repeats too
    n = len(of_periods)
    # A single period does not show its noise: the noise floor is spread evenly over the lines.
    noise = of_periods.var(axis=0, ddof=1) if n > 1 else np.full(K + 1, s.noise**2 / (K + 1))
    excited = np.isin(np.arange(K + 1), record.lines)
    velocity_power = np.abs(spectra[:, -1].mean(axis=0)) ** 2
    velocity_power[0] = 0.0  # a mean velocity only comes from the ends that were cut off
    power_before = np.abs(of_periods.mean(axis=0)) ** 2 - noise / n
    power_after = np.abs(spectra[:, -2].mean(axis=0)) ** 2 - noise / n
    frequency = np.asarray(np.arange(K + 1) * base_frequency, dtype=np.float64)
    return SpectralLines(
        s.group, s.equation, frequency, power_before, noise, power_after, excited,
        _shares(power_before, noise / n, excited), _shares(power_after, noise / n, excited),
        _shares(velocity_power, np.zeros(K + 1), excited), above_noise,
    )  # fmt: skip


def _half_period_pairs(place: NDArray[np.int64], period_rows: int) -> list[NDArray[np.int64]]:
    """Return the pairs (p, 2) of row numbers half a period apart, for each nearly whole period."""
    if period_rows % 2:
        return []
    row_at = np.full(int(place[-1]) + 1 + period_rows if len(place) else period_rows, -1)
    row_at[place] = np.arange(len(place))
    whole = len(row_at) // period_rows * period_rows
    halves = row_at[:whole].reshape(-1, 2, period_rows // 2).transpose(0, 2, 1)
    complete = [p[(p >= 0).all(axis=1)] for p in halves]
    return [p for p in complete if len(p) >= DATA.least_period_share * period_rows / 2]


def spectrum(phase: Array, series: Array, K: int) -> NDArray[np.complex128]:
    """Return the rms amplitudes (s, K + 1) of lines 0..K of series (s, p, 2).

    `series` are pairs at phases (p,) [periods] and half a period later; |amplitude|^2 sums to the
    mean square.
    """
    first, second = series[..., 0], series[..., 1]
    out = np.zeros((len(series), K + 1), dtype=np.complex128)
    for start, part in ((0, 0.5 * (first + second)), (1, 0.5 * (first - second))):
        number = np.arange(start, K + 1, 2)
        angle = 2 * np.pi * np.outer(phase, number)
        X = np.sqrt(np.where(number, 2.0, 1.0)) * np.stack((np.cos(angle), np.sin(angle)))
        X = np.concatenate(tuple(X), axis=1)
        weight = X.T @ X / len(phase) + DATA.line_ridge * np.eye(X.shape[1])
        amplitudes = np.linalg.solve(weight, X.T @ part.T / len(phase)).T
        out[:, start::2] = amplitudes[:, : len(number)] - 1j * amplitudes[:, len(number) :]
    return out


def lines_by_kind(excited: NDArray[np.bool_]) -> dict[str, NDArray[np.bool_]]:
    """Return a mask (K + 1,) of the lines 0..K for each kind of line."""
    number = np.arange(len(excited))
    odd = (number % 2 == 1) & ~excited
    even = (number % 2 == 0) & (number > 0)
    return dict(zip(KINDS, (number == 0, excited, odd, even), strict=True))


def _shares(power: Array, noise: Array, excited: NDArray[np.bool_]) -> dict[str, float]:
    """Return the share of the power by kind of line, 0 for a kind within the noise."""
    sums = {}
    for kind, of_kind in lines_by_kind(excited).items():
        power_of_kind = float(power[of_kind].sum())
        scatter = float(np.sqrt(np.sum(noise[of_kind] ** 2)))
        sums[kind] = power_of_kind if power_of_kind > DATA.line_deviations * scatter else 0.0
    total_power = sum(sums.values())
    return {kind: v / total_power if total_power > 0 else 0.0 for kind, v in sums.items()}


def largest_residual_lines(lines: Sequence[SpectralLines]) -> list[SpectralLines]:
    """Return the lines of at most three equations whose residual exceeds the noise."""
    best: dict[str, SpectralLines] = {}
    for equation_lines in lines:
        if equation_lines.above_noise >= 1.0:
            best.setdefault(equation_lines.equation, equation_lines)
    return list(best.values())[:3]
