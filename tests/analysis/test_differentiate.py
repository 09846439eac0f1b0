"""A filter that the balances can trust: nothing shifted, derivatives those of the value."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import convolve, lfilter

from analysis.signals import filters as d
from analysis.signals.convolution import convolved, decimated, same_convolved
from analysis.signals.settings import SIGNALS
from rig.model.numerics.spectra import noise_power, power_spectrum
from rig.model.parse import InputError
from rig.model.rig import Rig
from tests.studies.estimators import other_filters
from tests.studies.estimators.differentiation import markdown, table

RATE = 1000.0
FIR = [
    d.moving_average(RATE),
    d.butterworth(RATE, 80.0),
    other_filters.savitzky_golay(RATE),
    other_filters.smoothing_spline(RATE, 80.0),
    d.channel_filter(RATE),
    d.row_filter(RATE, 15.0),
]


@pytest.mark.parametrize("smoother", FIR, ids=lambda s: s.name)
@pytest.mark.parametrize("hertz", [1.0, 3.0, 9.5])
def test_value_and_derivatives_of_a_sine_share_one_gain_and_no_phase(
    smoother: d.Smoother, hertz: float
) -> None:
    t = np.arange(4000) / RATE
    w = 2 * np.pi * hertz
    x = np.sin(w * t + 0.4)
    inner = slice(smoother.reach, -smoother.reach)
    quadrature = np.cos(w * t + 0.4)
    gains = []
    for order, wanted in enumerate((x, w * quadrature, -w * w * x)):
        found = smoother.apply(x, order)[inner]
        gain = found @ wanted[inner] / (wanted[inner] @ wanted[inner])
        # Nothing is left beside the wanted signal, so the phase is zero.
        assert np.abs(found - gain * wanted[inner]).max() < 2e-3 * w**order
        gains.append(gain)
    # The paper's average takes 6 % at 9.5 Hz: from all alike, which is what counts.
    assert gains == pytest.approx([gains[0]] * 3, rel=2e-3)


@pytest.mark.parametrize("smoother", [d.channel_filter(RATE), d.row_filter(RATE, 15.0)])
def test_the_default_filters_change_nothing_in_their_band(smoother: d.FirSmoother) -> None:
    t = np.arange(3000) / RATE
    x = 3.0 + np.sin(2 * np.pi * 9.5 * t)
    inner = slice(smoother.reach, -smoother.reach)
    assert np.abs(smoother.apply(x) - x)[inner].max() < 2e-4


def test_polynomials_are_differentiated_exactly() -> None:
    t = np.arange(600) / RATE
    x = 1.0 - 2.0 * t + 3.0 * t**2
    for smoother in FIR[2:]:
        inner = slice(smoother.reach, -smoother.reach)
        assert smoother.apply(x, 1)[inner] == pytest.approx((-2 + 6 * t)[inner], abs=2e-6)
        assert smoother.apply(x, 2)[inner] == pytest.approx(np.full(600, 6.0)[inner], abs=2e-3)


def test_fourier_is_exact_on_whole_periods_that_drift() -> None:
    t = np.arange(2000) / RATE
    x = np.cos(2 * np.pi * 4 * t) + 0.3 * t
    wanted = -8 * np.pi * np.sin(2 * np.pi * 4 * t) + 0.3
    smoother = other_filters.FourierSmoother(RATE, 40.0)
    inner = slice(smoother.reach, -smoother.reach)
    assert np.abs(smoother.apply(x, 1) - wanted)[inner].max() < 0.01


def test_decimation_picks_samples_of_the_filtered_rows() -> None:
    x = np.random.default_rng(0).standard_normal((1001, 3))
    low = d.row_filter(RATE, 20.0)
    step = d.row_step(RATE, 20.0)
    kept = low.decimate(x, step)
    full = low.apply(x)
    first = -(-2 * low.reach // step) * step - low.reach
    assert kept == pytest.approx(full[first::step][: len(kept)])
    assert first >= low.reach
    assert first + (len(kept) - 1) * step + low.reach < len(x)
    # Honest decimation: what the filter lets through lies below the new Nyquist frequency.
    response = np.abs(np.fft.rfft(low.taps[0], 8192))
    beyond = np.fft.rfftfreq(8192, 1 / RATE) > 0.5 * RATE / step
    assert response[beyond].max() < 1e-3


@pytest.mark.parametrize("shift", [0.37, -0.07, -3.4, 5.0])
def test_alignment_moves_a_signal_by_fractions_of_a_sample(shift: float) -> None:
    n = np.arange(3000)
    x = np.sin(2 * np.pi * 0.02 * n + 0.1)
    wanted = np.sin(2 * np.pi * 0.02 * (n + shift) + 0.1)
    assert np.abs(d.align(x, shift) - wanted)[60:-60].max() < 1e-4


def test_the_octave_above_a_frequency_is_passed_and_nothing_else() -> None:
    taps = d.band_filter(1000.0, 20.0).taps[0]
    frequency = np.fft.rfftfreq(1 << 14, 1e-3)
    gain = np.abs(np.fft.rfft(taps, 1 << 14))
    assert gain[(frequency > 33.0) & (frequency < 39.0)] == pytest.approx(1.0, abs=1e-3)
    assert gain[(frequency < 19.0) | (frequency > 65.0)] == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize("corner", [np.inf, 20.0])
def test_noise_is_measured_in_the_octave_where_it_is_strongest(corner: float) -> None:
    """White noise, and noise behind a pole; the motion is a thousand times as large."""
    rate, pole = 500.0, np.exp(-2 * np.pi * corner / 500.0)
    white = 1e-5 * np.random.default_rng(4).standard_normal(20_000)
    noise = lfilter([1 - pole], [1, -pole], white)  # of gain 1 at low frequencies
    motion = 0.01 * np.sin(2 * np.pi * 1.3 * np.arange(20_000) / rate)
    power = noise_power(*power_spectrum(motion + noise, rate), 15.0)
    at_octave = 1.0 / (1.0 + (21.0 / corner) ** 2)  # of the pole, at the octave's middle
    assert power == pytest.approx(1e-10 * at_octave, rel=0.12)


def test_a_path_is_filtered_until_its_noise_is_slow() -> None:
    """The more noise, the narrower; what is left is as slow as the settings say."""
    rate, rng = 1000.0, np.random.default_rng(2)
    t = np.arange(20_000) / rate
    motion, speed = 0.02 * np.sin(2 * np.pi * 0.7 * t), 0.02 * 2 * np.pi * 0.7 * np.cos(4.4 * t)
    edges = []
    for size in (0.0, 5e-6, 3e-5, 1e-4, 3e-4):
        noise = size * rng.standard_normal(len(t))
        edges.append(d.path_cutoff(motion + noise, speed, rate))
        if np.isfinite(edges[-1]) and edges[-1] > min(SIGNALS.path_cutoffs):
            left = d.row_filter(rate, edges[-1]).apply(noise, 1)
            assert np.std(left) < 1.6 * SIGNALS.path_noise * np.sqrt(np.mean(speed**2))
    assert edges[0] == edges[1] == np.inf
    assert edges == sorted(edges, reverse=True)
    assert edges[-1] == min(SIGNALS.path_cutoffs)
    assert d.path_cutoff((motion + noise)[:300], speed[:300], rate) == np.inf  # too short for it


def test_a_record_shorter_than_the_filter_is_refused() -> None:
    with pytest.raises(InputError, match="too short for the filter"):
        d.channel_filter(RATE).apply(np.zeros(40))


def test_a_filter_beyond_nyquist_is_refused() -> None:
    with pytest.raises(InputError, match="sample rate above 240 Hz"):
        d.windowed_sinc(200.0, 80.0, 40.0)


@pytest.mark.slow
def test_the_study_shows_why_the_default_is_the_default(rig: Rig) -> None:
    entries = table(rig, np.random.default_rng(3), repeats=1)
    by = {(e.excitation.split()[0], e.filtering.split(";")[0]): e for e in entries}
    for excitation in ("sine", "multisine"):
        default = by[excitation, "default (windowed sinc, 80 Hz"]
        paper = by[excitation, "moving average, 20 samples"]
        assert max(default.bias.values()) < 0.5
        assert default.bias["inertia"] < 0.1 * max(
            e.bias["inertia"] for e in entries if e.excitation.startswith(excitation)
        )
        assert paper.bias["inertia"] >= default.bias["inertia"] or "rows" in paper.filtering
    assert markdown(entries).count("\n") == len(entries) + 1


@given(
    st.integers(1, 400), st.sampled_from([(), (1,), (3,)]), st.integers(0, 40), st.integers(1, 30),
    st.integers(0, 1000),
)  # fmt: skip
def test_own_convolutions_are_scipys(
    extra: int, shape: tuple[int, ...], reach: int, step: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    taps = rng.normal(size=2 * reach + 1)
    x = rng.normal(size=(2 * reach + extra, *shape))
    along = taps.reshape(-1, *(1 for _ in shape))
    whole = convolve(x, along, "full", "direct")
    inside = whole[2 * reach : len(x)]
    np.testing.assert_allclose(convolved(x, taps), inside, atol=1e-11)
    np.testing.assert_allclose(same_convolved(x, taps), whole[reach : reach + len(x)], atol=1e-11)
    every = [k for k in range(0, len(x), step) if k >= 2 * reach]
    np.testing.assert_allclose(decimated(x, taps, step), whole[every], atol=1e-11)
