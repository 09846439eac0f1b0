"""Checks of outputs: waveforms and laws sample by sample, limits, zero."""

from __future__ import annotations

import math

import numpy as np

from drivers.base import OutputLaw
from drivers.conformance.catalogue import PROBE, SATURATION, TWO_JOINTS, check
from drivers.conformance.trial import Trial, require_law, steps
from drivers.conformance.watched import require

_BLOCKS = 12
_LONG = 3001  # samples: more than any wire carries at once
_NAN, _INF = float("nan"), float("inf")


@check()
def waveform_is_played(trial: Trial) -> None:
    """An uploaded waveform is put out sample by sample from the tick that `apply` returns."""
    driver, wave = trial.ready(), trial.wave()
    driver.upload(0, wave)
    driver.read(2)
    trial.restarted(driver, trial.law(gain=0.5, bias=0.1 * trial.volts), {0: wave}, _BLOCKS)


@check()
def long_waveform_is_played(trial: Trial) -> None:
    """A waveform of 3001 samples is put out whole and begins again after its last sample."""
    driver, wave = trial.ready(), trial.wave(_LONG, seed=2)
    driver.upload(0, wave)
    rows = len(driver.read_block().data)
    count = math.ceil((_LONG + 60) / rows)
    trial.restarted(driver, trial.law(gain=1.0), {0: wave}, count)


@check()
def phase_is_kept_without_restart(trial: Trial) -> None:
    """`apply` without restart keeps the waveform's phase; with restart it begins again."""
    driver, wave = trial.ready(), trial.wave()
    driver.upload(0, wave)
    first, second = trial.law(gain=1.0), trial.law(gain=0.5)
    origin = trial.restarted(driver, first, {0: wave}, 3).origin
    tick = driver.apply(second)
    trial.until_law(driver, trial.playing(second, {0: wave}, origin), tick, 3)
    trial.restarted(driver, second, {0: wave}, 3)


@check()
def start_restarts_waveform(trial: Trial) -> None:
    """`start` begins the waveforms at the first sample of the stream."""
    driver, wave = trial.ready(), trial.wave()
    driver.upload(0, wave)
    laws = trial.law(gain=1.0)
    trial.restarted(driver, laws, {0: wave}, 3)
    driver.start()
    block = driver.read_block()
    require(block.sequence == 0, f"the stream begins with block {block.sequence}")
    require_law(block, trial.playing(laws, {0: wave}, block.tick), trial.rig)


@check()
def upload_waits_for_apply(trial: Trial) -> None:
    """A waveform uploaded while another plays acts from the next `apply` on."""
    driver, wave, other = trial.ready(), trial.wave(), trial.wave(seed=3)
    driver.upload(0, wave)
    laws = trial.law(gain=1.0)
    playing = trial.restarted(driver, laws, {0: wave})
    driver.upload(0, other)
    trial.until_law(driver, playing, playing.origin, 2)
    trial.restarted(driver, laws, {0: other})


@check(TWO_JOINTS)
def joints_are_separate(trial: Trial) -> None:
    """Each joint has its own waveform and law; a law of one joint leaves the others at zero."""
    driver = trial.ready()
    waves = {joint: trial.wave(50 + 7 * joint, seed=10 + joint) for joint in range(trial.joints)}
    for joint, wave in waves.items():
        driver.upload(joint, wave)
    laws = [OutputLaw(gain=0.9 - 0.1 * j, limit=trial.volts) for j in range(trial.joints)]
    trial.restarted(driver, laws, waves, 4)
    for joint in range(trial.joints):
        trial.restarted(driver, trial.law(joint, gain=0.5, bias=0.1 * trial.volts), waves)


@check()
def limit_bounds_the_sum(trial: Trial) -> None:
    """Waveform, bias and position law together stay within the law's limit, either way."""
    driver, wave = trial.ready(), trial.wave()
    driver.upload(0, wave)
    for values in (
        {"gain": 1.0, "bias": 0.5 * trial.volts, "limit": 0.4 * trial.volts},
        {"bias": -trial.volts, "limit": 0.3 * trial.volts},
        {"gain": 1.0, "bias": trial.volts, "limit": 0.0},
        {"position_gain": 1e4, "setpoint": -0.02, "limit": 0.2 * trial.volts},
    ):
        laws = trial.law(0, **values)
        tick = driver.apply(laws, restart=True)
        bound = values["limit"] + steps(trial.rig)[0] + 1e-9
        for block in driver.read(3):
            rows = block.data[max(0, tick - block.tick) :, len(trial.rig.channels)]
            peak = float(np.abs(rows).max(initial=0.0))
            require(peak <= bound, f"{peak:.3f} V under a limit of {values['limit']:.3f} V")
        if "position_gain" not in values:
            trial.until_law(driver, trial.playing(laws, {0: wave}, tick), tick, 1)


@check()
def position_law_pulls_to_setpoint(trial: Trial) -> None:
    """A position law's command has the sign of the setpoint minus the position."""
    driver, rig = trial.ready(), trial.rig
    column = rig.recorded.index(f"{rig.position_kind}_1")
    position = float(driver.read_block().data[-1, column])
    for error in (0.01, -0.01):
        laws = trial.law(position_gain=0.5 * trial.volts / abs(error), setpoint=position + error)
        tick = driver.apply(laws)
        block = driver.read_block()
        while block.tick + len(block.data) <= tick:
            block = driver.read_block()
        command = float(block.data[max(0, tick - block.tick), len(rig.channels)])
        expected = 0.5 * trial.volts * np.sign(error)
        fits = abs(command - expected) < 0.3 * trial.volts
        require(fits, f"{command:.3f} V at {error:+g} m to the setpoint, expected {expected:.3f} V")
        position = float(block.data[-1, column])


@check()
def impossible_laws_refused(trial: Trial) -> None:
    """A law that is not finite, of a negative limit, beyond the converter or for a wrong number of
    joints is refused, and the law before it stays in force."""
    driver, good = trial.ready(), trial.driving()
    tick = driver.apply(good)
    for joint in range(trial.joints):
        top = trial.rig.joints[joint].valve.command_range
        for what, values in (
            ("a bias of NaN", {"bias": _NAN}),
            ("a gain of NaN", {"gain": _NAN}),
            ("an infinite gain", {"gain": _INF}),
            ("an infinite setpoint", {"setpoint": -_INF}),
            ("a limit of NaN", {"limit": _NAN}),
            ("a negative limit", {"limit": -0.1 * trial.volts}),
            ("a limit beyond the converter", {"limit": 1.5 * top}),
        ):
            bad = trial.law(joint, **values)
            trial.refused(what, lambda bad=bad: driver.apply(bad))  # type: ignore[misc]
    for wrong in ([], good[:-1], [*good, good[0]]):
        what = f"{len(wrong)} laws for {trial.joints} joints"
        trial.refused(what, lambda wrong=wrong: driver.apply(wrong))  # type: ignore[misc]
    trial.until_law(driver, trial.playing(good), tick, 2)


@check()
def impossible_waveforms_refused(trial: Trial) -> None:
    """A waveform that is empty, not finite, beyond the converter or for no joint is refused, and
    the one before it stays."""
    driver, wave = trial.ready(), trial.wave()
    driver.upload(0, wave)
    top = trial.rig.joints[0].valve.command_range
    for what, joint, bad in (
        ("an empty waveform", 0, np.zeros(0)),
        ("a waveform with NaN", 0, np.array([0.0, _NAN])),
        ("an infinite waveform", 0, np.array([0.0, _INF])),
        ("a waveform beyond the converter", 0, np.array([0.0, 1.01 * top])),
        ("a waveform of a joint too many", trial.joints, np.zeros(3)),
        ("a waveform of joint 0", -1, np.zeros(3)),
    ):
        trial.refused(what, lambda joint=joint, bad=bad: driver.upload(joint, bad))  # type: ignore[misc]
    trial.restarted(driver, trial.law(gain=1.0), {0: wave})


@check()
def zero_within_one_block(trial: Trial) -> None:
    """After `zero_outputs` the samples show zero on every joint, whichever term drove it."""
    driver = trial.ready()
    for joint in range(trial.joints):
        driver.upload(joint, trial.wave())
    terms = {
        "waveform": {"gain": 1.0},
        "bias": {"bias": 0.8 * trial.volts},
        "position law": {"position_gain": 1e4, "setpoint": 0.01},
    }
    for what, values in terms.items():
        laws = [OutputLaw(limit=trial.volts, **values) for _ in range(trial.joints)]
        driver.apply(laws, restart=True)
        driver.read(2)
        driver.zero_outputs()
        trial.zero_at_device(f"after zero_outputs of a {what}")
        trial.zero_in_stream(driver, f"after zero_outputs of a {what}", soon=True)
        trial.zero_in_stream(driver, f"a block after zero_outputs of a {what}", soon=True)


@check()
def zero_is_for_good(trial: Trial) -> None:
    """After `zero_outputs` neither `start` nor an upload nor a law of another joint brings the
    law back."""
    driver = trial.ready()
    driver.apply(trial.driving())
    driver.read(2)
    driver.zero_outputs()
    driver.start()
    trial.zero_in_stream(driver, "after zero_outputs and start", soon=True)
    driver.upload(0, trial.wave())
    trial.zero_in_stream(driver, "after zero_outputs and an upload", soon=True)
    laws = trial.law(trial.joints - 1, bias=0.5 * trial.volts)
    tick = driver.apply(laws)
    trial.until_law(driver, trial.playing(laws), tick, 2)


@check()
def session_again_has_no_laws(trial: Trial) -> None:
    """A new session begins without the laws of the one before: outputs zero until `apply`."""
    driver = trial.ready()
    driver.upload(0, trial.wave())
    driver.apply(trial.driving(), restart=True)
    driver.read(2)
    driver.close()
    trial.connected(driver)
    driver.start()
    trial.zero_in_stream(driver, "in a new session")
    trial.restarted(driver, trial.off(), {})


@check()
def stopped_stream_keeps_laws(trial: Trial) -> None:
    """A law applied while the stream is stopped drives from the stream's first sample on."""
    driver = trial.ready()
    driver.read(2)
    driver.stop()
    laws = trial.driving()
    tick = driver.apply(laws)
    driver.start()
    trial.until_law(driver, trial.playing(laws), tick, 2)


@check()
def off_law_is_zero(trial: Trial) -> None:
    """Laws of zeros put every output to zero from the tick that `apply` returns."""
    driver = trial.ready()
    driver.apply(trial.driving())
    driver.read(2)
    tick = driver.apply(trial.off())
    trial.until_law(driver, trial.playing(trial.off()), tick, 2)


@check(PROBE)
def probe_agrees_with_samples(trial: Trial) -> None:
    """The device puts out the commands that its samples show."""
    driver, laws = trial.ready(), trial.driving()
    driver.apply(laws)
    driver.read(3)
    assert trial.bench.outputs is not None
    probed = np.asarray(trial.bench.outputs(), dtype=np.float64)
    expected = np.array([law.bias for law in laws])
    fits = np.abs(probed - expected) <= 1.1 * steps(trial.rig) + 1e-9
    require(fits.all(), f"the device puts out {probed} V, the samples show {expected} V")


@check(SATURATION, moves=False)
def saturation_is_marked(trial: Trial) -> None:
    """A sensor at an end of its range is marked in its column, and only there."""
    driver = trial.ready()
    before = driver.read_block()
    assert trial.bench.saturate is not None
    column = trial.bench.saturate()
    name = trial.rig.channels[column]
    driver.read(2)
    after = driver.read_block()
    require(after.saturated[:, column].all(), f"{name} at the end of its range is not marked")
    newly_marked = np.flatnonzero(after.saturated.all(axis=0) & ~before.saturated.any(axis=0))
    others = [trial.rig.channels[k] for k in newly_marked if k != column]
    require(not others, f"{' '.join(others)} marked as well as {name}")
