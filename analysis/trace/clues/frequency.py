"""Frequency clue: the residual repeats at one frequency, whatever the joint does.

Causes are hum of a pump, of the mains, of a control loop. Most of the power of the training
residual lies at one line although the excitation has many. The frequency is searched around that
line and judged on the held-out records, where a sine and a cosine of it, with a phase for each
record, must remove most of the energy above noise.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from analysis.trace.data.regression_data import RegressionData
from analysis.trace.data.spectral_lines import SpectralLines
from analysis.trace.result import Dependence
from analysis.trace.search.hypothesis import energy_above_noise
from analysis.trace.settings import CLUES

Array = NDArray[np.float64]

FREQUENCY = "frequency"


def frequency_clue(
    lines: Sequence[SpectralLines],
    train: RegressionData,
    residual: Array,
    holdout_data: RegressionData,
    holdout_residual: Array,
) -> Dependence | None:
    """Return the clue of the equation with the largest residual at one frequency, None if none.

    `residual` (M,) and `holdout_residual` are the whitened residuals of the averaged training and
    held-out records.
    """
    for equation_lines in sorted(
        lines, key=lambda equation_lines: -equation_lines.above_noise_after
    ):
        near = _peak_frequency(equation_lines) if equation_lines.above_noise_after >= 1.0 else None
        if near is None:
            continue
        width = equation_lines.frequency[1]
        tried = np.linspace(near - width, near + width, CLUES.frequency_steps)
        f = max(
            tried, key=lambda f: _energy_of_sine(train, residual, equation_lines.equation, float(f))
        )
        energy = energy_above_noise(holdout_data, holdout_residual)[equation_lines.equation]
        share = _energy_of_sine(
            holdout_data, holdout_residual, equation_lines.equation, float(f)
        ) / max(energy, 1e-300)
        if energy > 0 and share >= CLUES.frequency_share:
            words = f"a frequency of {f:.3g} Hz"
            return Dependence(FREQUENCY, min(1.0, share), equation_lines.equation, words=words)
    return None


def _peak_frequency(lines: SpectralLines) -> float | None:
    """Return the frequency [Hz] of most of the remaining power, None where it is spread."""
    power = np.maximum(lines.after, 0.0)
    power[0] = 0.0
    if int(lines.excited.sum()) < CLUES.least_lines or not power.any():
        return None
    k = int(np.argmax(power))
    if k < CLUES.first_line:
        return None
    here = slice(k - CLUES.side_lines, k + CLUES.side_lines + 1)
    if power[here].sum() < CLUES.peak_share * power.sum():
        return None
    return float(np.average(lines.frequency[here], weights=power[here]))


def _energy_of_sine(data: RegressionData, residual: Array, equation: str, f: float) -> float:
    """Return the energy above noise that a sine and a cosine of f [Hz] remove in all records."""
    total = 0.0
    for conditioned, rows in zip(data.records, data.rows, strict=True):
        for s in data.segments:
            if s.group == conditioned.group and s.equation == equation:
                angle = 2 * np.pi * f * rows[equation].time
                waves = np.column_stack((np.sin(angle), np.cos(angle)))
                Q, _ = np.linalg.qr(waves)
                total += float(np.sum((Q.T @ residual[s.where]) ** 2)) - 2.0
    return total
