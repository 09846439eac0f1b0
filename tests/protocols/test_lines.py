"""Signals of chosen lines: what a file says is what is played, and a file can be written back."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from protocols.files import library
from protocols.files.plan import Overrides, override
from protocols.files.schema import Protocol
from protocols.files.writer import protocol_text
from protocols.signals.lines import Lines, chosen_lines
from rig.model.parse import InputError, parse_model

TEXT = """
name: mine
joints: 1
steps:
  - name: step1
    excite:
      - joint: 1
        signal:
          kind: lines
          base_frequency: 0.5 Hz
          lines: [1, 3, 8]
          amplitudes: [0.2 V, 100 mV, 0.05 V]
          phases: [0 deg, 90 deg, -1 rad]
          detection_lines: [5]
"""


def signal(text: str = TEXT) -> Lines:
    found = parse_model(Protocol, text, "mine.yaml").steps[0].excite[0].signal
    assert isinstance(found, Lines)
    return found


def test_the_wave_is_the_sum_the_file_says_started_centred() -> None:
    wave = signal().waveform(1000.0)
    t = np.arange(2000) / 1000.0
    expected = (
        0.2 * np.cos(2 * np.pi * 0.5 * t)
        + 0.1 * np.cos(2 * np.pi * 1.5 * t + np.pi / 2)
        + 0.05 * np.cos(2 * np.pi * 4.0 * t - 1)
    )
    lag = int(np.argmax(np.fft.irfft(np.fft.rfft(wave.samples) * np.conj(np.fft.rfft(expected)))))
    assert np.roll(expected, lag) == pytest.approx(wave.samples, abs=1e-12)
    assert wave.lines == (1, 3, 8)
    assert wave.detection_lines == (5,)
    motion = np.cumsum(wave.samples)
    assert abs(motion[0] - motion.mean()) < 2 * np.abs(wave.samples).max()


def test_any_waveform_can_be_written_as_lines_and_read_back() -> None:
    protocol = library.load("lock-and-excite-multisine")
    part = protocol.steps[0].excite[0]
    wave = part.signal.waveform(1000.0)
    lines = chosen_lines(wave, 0.1)
    step = protocol.steps[0].model_copy(
        update={"excite": (part.model_copy(update={"signal": lines}),)}
    )
    changed = protocol.model_copy(update={"steps": (step, *protocol.steps[1:])})
    text = protocol_text(changed, "Made by a test.")
    assert text.startswith("# Made by a test.\n")
    again = parse_model(Protocol, text, "again.yaml")
    back = again.steps[0].excite[0].signal.waveform(1000.0)
    # Five digits are written of each amplitude and phase.
    assert back.samples == pytest.approx(wave.samples, abs=2e-4 * np.abs(wave.samples).max())
    assert back.lines == wave.lines
    assert back.detection_lines == wave.detection_lines
    assert again.steps[1:] == protocol.steps[1:]


def test_amplitudes_scale_together() -> None:
    twice = signal().scaled(2.0)
    assert isinstance(twice, Lines)
    assert twice.amplitudes == pytest.approx((0.4, 0.2, 0.1))
    protocol = parse_model(Protocol, TEXT, "mine.yaml")
    half = override(protocol, Overrides(amplitude_scale=0.5, seed=3)).steps[0].excite[0].signal
    assert isinstance(half, Lines)
    assert half.amplitudes == pytest.approx((0.1, 0.05, 0.025))


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("[0.2 V, 100 mV, 0.05 V]", "[0.2 V, 100 mV]", "amplitudes has 2 entries for 3 lines"),
        ("0.05 V]", "0 V]", "leave a line out"),
        ("[1, 3, 8]", "[3, 1, 8]", "rising order"),
        ("detection_lines: [5]", "detection_lines: [3]", "line 3 is excited"),
        ("0.2 V,", "0.2,", "unit"),
    ],
)
def test_what_does_not_fit_is_refused_with_its_line(old: str, new: str, says: str) -> None:
    with pytest.raises((InputError, ValidationError), match=says):
        signal(TEXT.replace(old, new))
