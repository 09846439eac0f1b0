"""One period of an excitation holds exactly the lines that were asked for, and nothing else."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocols.language.waveforms import Array, whole_period
from protocols.signals.multisine import Multisine
from protocols.signals.sine import Sine

RATE = 1000.0


def amplitudes(samples: Array) -> Array:
    """Amplitude of each line of one period, by FFT."""
    return 2.0 * np.abs(np.fft.rfft(samples)) / len(samples)


def multisine(**changes: object) -> Multisine:
    asked = {
        "kind": "multisine", "base_frequency": 0.1, "f_min": 0.3, "f_max": 9.5,
        "amplitude": 0.5, "seed": 7,
    }  # fmt: skip
    return Multisine.model_validate({**asked, **changes})


def test_a_one_hertz_sine_is_one_line_of_the_asked_amplitude() -> None:
    wave = Sine(kind="sine", frequency=1.0, amplitude=0.8).waveform(RATE)
    assert wave.period == 1000
    assert wave.lines == (1,)
    lines = amplitudes(wave.samples)
    assert lines[1] == pytest.approx(0.8)
    assert np.delete(lines, 1).max() < 1e-12


def test_three_hertz_repeats_with_the_sample_clock_after_three_cycles() -> None:
    """333.3 samples are no period: three cycles are, and records of them start alike."""
    wave = Sine(kind="sine", frequency=3.0, amplitude=1.0).waveform(RATE)
    assert (wave.period, wave.lines) == (1000, (3,))
    twice = np.tile(wave.samples, 2)
    assert np.abs(np.diff(twice)).max() < 1.001 * 2 * np.pi * 3 / RATE  # no jump at the seam


def test_a_frequency_that_never_meets_the_clock_is_refused() -> None:
    with pytest.raises(ValueError, match="never meets the sample clock"):
        Sine(kind="sine", frequency=3.00017, amplitude=1.0).waveform(RATE)


@given(
    cycles=st.integers(1, 40), samples=st.integers(81, 5000), rate=st.sampled_from([500.0, 1000.0])
)
def test_whole_periods_are_whole_and_shortest(cycles: int, samples: int, rate: float) -> None:
    found_cycles, found_samples = whole_period(cycles * rate / samples, rate)
    assert found_cycles * samples == pytest.approx(found_samples * cycles, rel=1e-5)
    assert np.gcd(found_cycles, found_samples) == 1


@settings(max_examples=30)
@given(
    seed=st.integers(0, 2**31),
    tilt=st.sampled_from([0.0, 0.5, 1.0]),
    fraction=st.sampled_from([0.0, 0.2, 0.25, 0.5]),
    measure=st.sampled_from(["rms", "peak"]),
)
def test_a_multisine_has_the_asked_spectrum(
    seed: int, tilt: float, fraction: float, measure: str
) -> None:
    wave = multisine(
        seed=seed, tilt=tilt, detection_fraction=fraction, amplitude_is=measure, draws=5
    ).waveform(RATE)
    lines = amplitudes(wave.samples)
    excited = np.array(wave.lines)
    assert wave.period == 10_000
    assert (excited % 2 == 1).all()
    assert excited.min() >= 3
    assert excited.max() <= 95
    silent = np.setdiff1d(np.arange(len(lines)), excited)
    assert lines[silent].max() < 1e-12 * lines.max() * 1e3
    assert not set(wave.lines) & set(wave.detection_lines)
    shape = lines[excited] * excited**tilt
    np.testing.assert_allclose(shape, shape[0], rtol=1e-9)
    size = np.sqrt(np.mean(wave.samples**2)) if measure == "rms" else np.abs(wave.samples).max()
    assert size == pytest.approx(0.5)


def test_detection_lines_are_spread_over_the_band_one_in_each_group() -> None:
    wave = multisine(detection_fraction=0.25).waveform(RATE)
    candidates = list(range(3, 96, 2))
    for start in range(0, len(candidates) - 3, 4):
        group = set(candidates[start : start + 4])
        assert len(group & set(wave.detection_lines)) == 1
    gaps = np.diff(wave.detection_lines)
    assert len(set(gaps.tolist())) > 1  # at random, not every fourth


def test_named_detection_lines_are_left_empty() -> None:
    wave = multisine(detection_lines=(5, 7, 90)).waveform(RATE)
    assert wave.detection_lines == (5, 7, 90)
    assert not {5, 7, 90} & set(wave.lines)
    assert {3, 9, 11, 95} <= set(wave.lines)


def test_the_same_seed_gives_the_same_samples_and_another_does_not() -> None:
    first, again, other = (multisine(seed=s).waveform(RATE) for s in (1, 1, 2))
    np.testing.assert_array_equal(first.samples, again.samples)
    assert not np.allclose(first.samples, other.samples)


def test_more_draws_of_the_phases_give_a_flatter_waveform() -> None:
    def size(draws: int) -> float:
        """Product of peaks of command and of motion: what binds voltage and stroke."""
        waves = [multisine(seed=s, draws=draws).waveform(RATE).samples for s in range(10)]
        return float(np.mean([np.ptp(w) * np.ptp(np.cumsum(w)) for w in waves]))

    assert size(100) < 0.8 * size(1)


@pytest.mark.parametrize("seed", range(5))
def test_a_piston_driven_by_it_stays_about_where_it_started(seed: int) -> None:
    """The integral begins at its own mean, so a centred piston needs no run-up."""
    wave = multisine(seed=seed).waveform(RATE)
    piston = np.cumsum(wave.samples) / RATE
    assert abs(piston.mean()) < 0.01 * np.ptp(piston)


def test_a_period_that_is_no_whole_number_of_samples_is_refused() -> None:
    with pytest.raises(ValueError, match="not a whole number"):
        multisine(base_frequency=0.3, f_min=0.3).waveform(RATE)


def test_a_band_without_a_line_is_refused() -> None:
    with pytest.raises(ValueError, match="no line is left"):
        multisine(f_min=0.4, f_max=0.4).waveform(RATE)
