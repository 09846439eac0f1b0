"""Checks of a session: who answers, what is refused, order of calls, loss, trips, closing."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress

from drivers.base import DeviceError
from drivers.conformance.catalogue import CUT, IDENTITY, LATCH, LOSS, PROBE, SILENCE, check
from drivers.conformance.subject import HEALTHY
from drivers.conformance.trial import Trial, loss_raised_by, patiently
from drivers.conformance.watched import NotConforming, Watched, follows, require
from rig.model.parse import InputError
from rig.model.rig import Rig


@check(moves=False)
def identity(trial: Trial) -> None:
    """`connect` returns the rig's joints, channels and rate, and whether time is virtual."""
    info = trial.connected().info
    assert info is not None
    rig = trial.rig
    for what, actual, expected in (
        ("joints", info.joints, len(rig.joints)),
        ("channels", info.channels, len(rig.channels)),
        ("sample rate [Hz]", info.sample_rate, rig.sample_rate),
        ("virtual time", info.virtual_time, trial.claims.virtual_time),
    ):
        require(actual == expected, f"{what} {actual}, expected {expected}")
    require(info.identity, "the device has no name")
    require(info.block_samples > 0, f"{info.block_samples} samples in a block")


def _other_rigs(rig: Rig) -> Iterator[tuple[str, Rig]]:
    yield "twice the sample rate", rig.model_copy(update={"sample_rate": 2 * rig.sample_rate})
    if len(rig.joints) > 1:
        yield "a joint less", rig.model_copy(update={"joints": rig.joints[:-1]})
    if rig.sensors.oil_temperature is not None:
        fewer = rig.sensors.model_copy(update={"oil_temperature": None})
        yield "a channel less", rig.model_copy(update={"sensors": fewer})


@check(IDENTITY, moves=False)
def other_rig_refused(trial: Trial) -> None:
    """A device of another rate, number of joints or channels is refused by `connect`."""
    for what, rig in _other_rigs(trial.rig):
        try:
            driver = trial.driver(rig)
        except InputError:
            continue  # refused before a device was contacted: the wire cannot serve that rig
        trial.refused(f"a rig with {what}", driver.connect)
        driver.close()


@check(moves=False)
def unconnected_calls_refused(trial: Trial) -> None:
    """Before `connect` and after `close`, calls that need a device raise DeviceError."""
    driver = trial.driver()
    calls: dict[str, Callable[[], object]] = {
        "read_block": driver.read_block,
        "start": driver.start,
        "stop": driver.stop,
        "apply": lambda: driver.apply(trial.off()),
        "upload": lambda: driver.upload(0, 0.0 * trial.wave()),
        "trip_cause": driver.trip_cause,
    }
    for name, call in calls.items():
        trial.refused(f"{name} before connect", call)
    trial.connected(driver)
    driver.close()
    for name, call in calls.items():
        trial.refused(f"{name} after close", call)


@check(moves=False)
def close_any_time(trial: Trial) -> None:
    """`close` never raises: unconnected, while streaming, twice."""
    driver = trial.driver()
    driver.close()
    trial.connected(driver)
    driver.start()
    driver.close()
    driver.close()


@check(moves=False)
def read_without_start(trial: Trial) -> None:
    """`read_block` without a stream raises DeviceError: before `start`, after `stop`."""
    driver = trial.connected()
    trial.refused("read_block before start", driver.read_block)
    driver.start()
    driver.read(2)
    driver.stop()
    trial.refused("read_block after stop", driver.read_block)


@check(moves=False)
def samples_in_order(trial: Trial) -> None:
    """Blocks of a stream continue each other by sequence and tick, or count what is missing."""
    driver = trial.ready()
    blocks = driver.read(30)
    require(blocks[0].sequence == 0, f"a stream begins with block {blocks[0].sequence}")
    if trial.claims.virtual_time:
        missing = blocks[-1].sequence - blocks[0].sequence - len(blocks) + 1
        require(not missing, f"{missing} blocks are missing though time waits")


@check(moves=False)
def second_stream_is_new(trial: Trial) -> None:
    """After `start` blocks number anew and hold no sample from before, with or without `stop`."""
    driver = trial.ready()
    before = driver.read(5)[-1]
    for stops in (True, False):
        if stops:
            driver.stop()
        driver.start()
        after = driver.read_block()
        end = before.tick + len(before.data)
        require(after.sequence == 0, f"the new stream begins with block {after.sequence}")
        require(after.tick >= end, f"the new stream begins at tick {after.tick}, before {end}")
        before = after


@check(moves=False)
def session_again(trial: Trial) -> None:
    """The same driver connects again after `close`; it does not stream until `start`."""
    driver = trial.ready()
    driver.read(2)
    driver.close()
    trial.connected(driver)
    trial.refused("read_block of a new session before start", driver.read_block)
    driver.start()
    first = driver.read_block()
    require(first.sequence == 0, f"the new session begins with block {first.sequence}")
    follows(first, driver.read_block())


@check(moves=False)
def zero_any_time(trial: Trial) -> None:
    """`zero_outputs` works twice in a row, without a stream and during one, and ends none."""
    driver = trial.connected()
    driver.zero_outputs()
    driver.zero_outputs()
    driver.start()
    first = driver.read_block()
    driver.zero_outputs()
    follows(first, driver.read_block())
    driver.stop()
    driver.zero_outputs()


def _driven(trial: Trial) -> Watched:
    driver = trial.ready()
    driver.apply(trial.driving())
    driver.read(2)
    return driver


@check()
def zero_after_connect(trial: Trial) -> None:
    """`connect` leaves the outputs at zero, also after a session that ended with outputs on."""
    driver = _driven(trial)
    if trial.bench.cut is not None:
        trial.bench.cut()
    else:
        driver.close()
    after = trial.connected()
    trial.zero_at_device("after connect")
    after.start()
    trial.zero_in_stream(after, "after connect and start")


@check(PROBE)
def close_leaves_zero(trial: Trial) -> None:
    """`close` leaves the outputs at zero: driven by bias, by a waveform, by a position law."""
    for what, laws in (
        ("bias", trial.driving()),
        ("waveform", trial.law(gain=1.0)),
        ("position law", trial.law(position_gain=1e3, setpoint=0.01)),
    ):
        driver = trial.ready()
        driver.upload(0, trial.wave())
        driver.apply(laws, restart=True)
        driver.read(2)
        driver.close()
        trial.zero_at_device(f"after close of a session driven by a {what}")


@check(PROBE, CUT)
def lost_host_zeroes(trial: Trial) -> None:
    """The end of the host's link zeroes the outputs, at once or by the watchdog."""
    driver = _driven(trial)
    trial.cut()
    if trial.bench.silence is not None:
        trial.bench.silence()
    trial.zero_at_device("after the end of the link")
    with suppress(DeviceError):
        driver.read_block()


@check(PROBE, SILENCE)
def silent_host_zeroes(trial: Trial) -> None:
    """A host silent for longer than the watchdog allows finds the outputs at zero."""
    _driven(trial)
    trial.silence()
    trial.zero_at_device("after a silence longer than the watchdog")


@check(CUT, PROBE)
def zero_after_lost_link(trial: Trial) -> None:
    """`zero_outputs` works in a session whose link has ended, if the device can be reached."""
    driver = _driven(trial)
    trial.cut()
    try:
        patiently(driver.zero_outputs)
    except DeviceError as error:
        raise NotConforming(f"zero_outputs after the end of the link: {error}") from error
    trial.zero_at_device("after the end of the link and zero_outputs")


@check(CUT, moves=False)
def cut_link_is_lost(trial: Trial) -> None:
    """`read_block` over a link that has ended raises DeviceLost, and never an old block."""
    driver = trial.ready()
    driver.read(2)
    trial.cut()
    loss = loss_raised_by(driver.read_block)
    require(loss, "three calls of read_block after the end of the link raised no DeviceLost")


@check(LOSS, moves=False)
def silent_device_is_lost(trial: Trial) -> None:
    """`read_block` from a device that answers no more raises DeviceLost, never an old block."""
    for fault in trial.bench.lost:
        driver = trial.ready()
        driver.read(2)
        trial.spoil(fault)
        trial.refused(f"read_block with the wire at fault ({fault})", driver.read_block)
        loss = loss_raised_by(driver.read_block)
        require(loss, f"read_block with the wire at fault ({fault}) raised no DeviceLost")
        trial.spoil(HEALTHY)
        driver.close()


@check(LATCH, SILENCE)
def trip_is_reported(trial: Trial) -> None:
    """A tripped device reports it in `trip_cause` and marks its blocks."""
    driver = _driven(trial)
    trial.silence()
    require(driver.trip_cause() is not None, "trip_cause is None after a trip")
    driver.start()
    require(driver.read_block().tripped, "a block of a tripped device is not marked")


@check(LATCH, SILENCE)
def trip_latches(trial: Trial) -> None:
    """After a trip laws that drive are refused, through `start` and `connect`, until `reset`."""
    driver = _driven(trial)
    trial.silence()
    trial.refused("a driving law after a trip", lambda: driver.apply(trial.driving()))
    driver.apply(trial.off())
    driver.start()
    trial.refused("a driving law after a trip and start", lambda: driver.apply(trial.driving()))
    trial.zero_in_stream(driver, "after a trip", soon=True)
    driver.close()
    again = trial.connected()
    require(again.trip_cause() is not None, "connect cleared the trip")
    trial.refused("a driving law after a trip and connect", lambda: again.apply(trial.driving()))
    again.reset()
    require(again.trip_cause() is None, "reset did not clear the trip")
    again.start()
    laws = trial.driving()
    trial.until_law(again, trial.playing(laws), again.apply(laws), 2)


@check(LATCH, SILENCE)
def reset_drives_nothing(trial: Trial) -> None:
    """`reset` in the session that tripped leaves the outputs at zero until a law is applied."""
    driver = _driven(trial)
    trial.silence()
    driver.reset()
    trial.zero_at_device("after reset")
    driver.start()
    trial.zero_in_stream(driver, "after reset and start")


@check()
def reset_without_trip(trial: Trial) -> None:
    """`reset` of a device that is not tripped changes neither its outputs nor its stream."""
    driver = trial.ready()
    driver.reset()
    trial.zero_in_stream(driver, "after reset")
    laws = trial.driving()
    tick = driver.apply(laws)
    trial.until_law(driver, trial.playing(laws), tick, 2)
    driver.reset()
    require(driver.trip_cause() is None, "reset made a trip")
    trial.until_law(driver, trial.playing(laws), tick, 2)
