"""Checks over a wire that damages answers: which errors appear, and that zero is reached."""

from __future__ import annotations

from collections.abc import Callable

from drivers.base import DeviceError, SampleBlock
from drivers.conformance.catalogue import FAULTS, PROBE, check
from drivers.conformance.subject import HEALTHY
from drivers.conformance.trial import Playing, Trial, require_law
from drivers.conformance.watched import Watched, follows


def _driven(trial: Trial) -> tuple[Watched, Playing, SampleBlock]:
    """Return a driver that plays a waveform, the law it follows, and its last block."""
    driver, wave = trial.ready(), trial.wave(251, seed=5)
    driver.upload(0, wave)
    playing = trial.restarted(driver, trial.law(gain=1.0), {0: wave}, 1)
    return driver, playing, driver.read_block()


@check(FAULTS)
def spoiled_blocks_are_refused(trial: Trial) -> None:
    """While answers are spoiled `read_block` returns right blocks in order or raises; after an
    error `zero_outputs` works once the wire is healthy."""
    for fault in trial.bench.faults:
        driver, playing, before = _driven(trial)
        trial.spoil(fault)
        try:
            for _ in range(3):
                block = driver.read_block()
                follows(before, block)
                require_law(block, playing, trial.rig)
                before = block
        except DeviceError:
            trial.spoil(HEALTHY)
            trial.zero_somehow(driver, f"{fault}: after an error of read_block")
        trial.spoil(HEALTHY)
        driver.close()
        trial.zero_at_device(f"{fault}: after close")


@check(FAULTS)
def spoiled_calls_raise_declared_errors(trial: Trial) -> None:
    """With any fault of the answers, calls work or raise DeviceError, and nothing else."""
    calls: dict[str, Callable[[Watched], object]] = {
        "apply": lambda driver: driver.apply(trial.driving()),
        "upload": lambda driver: driver.upload(0, trial.wave(seed=6)),
        "start": lambda driver: driver.start(),
        "stop": lambda driver: driver.stop(),
        "trip_cause": lambda driver: driver.trip_cause(),
        "reset": lambda driver: driver.reset(),
    }
    for fault in trial.bench.faults:
        for name, call in calls.items():
            driver = trial.ready()
            driver.apply(trial.driving())
            trial.spoil(fault)
            try:
                call(driver)
            except DeviceError:
                trial.spoil(HEALTHY)
                trial.zero_somehow(driver, f"{fault}: after an error of {name}")
            trial.spoil(HEALTHY)
            driver.close()
            trial.zero_at_device(f"{fault}: after {name} and close")


@check(FAULTS, PROBE)
def spoiled_zero_is_zero(trial: Trial) -> None:
    """`zero_outputs` over a wire that spoils answers: where it returns the outputs are zero, where
    it raises a second call on the healthy wire zeroes them."""
    for fault in trial.bench.faults:
        driver, _, _ = _driven(trial)
        trial.spoil(fault)
        try:
            driver.zero_outputs()
        except DeviceError:
            trial.spoil(HEALTHY)
            trial.zero_somehow(driver, f"{fault}: after an error of zero_outputs")
        else:
            trial.zero_at_device(f"{fault}: after zero_outputs")
        trial.spoil(HEALTHY)
        driver.close()


@check(FAULTS)
def spoiled_close_is_quiet(trial: Trial) -> None:
    """`close` over a wire that spoils answers raises nothing and leaves the outputs at zero, at
    the latest when the watchdog's time has passed."""
    for fault in trial.bench.faults:
        driver, _, _ = _driven(trial)
        trial.spoil(fault)
        driver.close()
        trial.spoil(HEALTHY)
        if trial.bench.silence is not None:
            trial.bench.silence()
        trial.zero_at_device(f"{fault}: after close")


@check(FAULTS, moves=False)
def spoiled_connect_is_refused(trial: Trial) -> None:
    """`connect` over a wire that spoils answers works or raises DeviceError; it works again on
    the healthy wire."""
    for fault in trial.bench.faults:
        driver = trial.driver()
        trial.spoil(fault)
        try:
            driver.connect()
        except DeviceError:
            trial.spoil(HEALTHY)
            trial.connected(driver)
        trial.spoil(HEALTHY)
        driver.close()
