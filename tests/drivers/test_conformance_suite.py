"""The conformance suite is tested itself: it accepts a correct driver and rejects wrong ones."""

from __future__ import annotations

import pytest

from drivers.conformance import CheckVerdict, RandomCallBudget, all_checks, run
from tests.drivers import mutants
from tests.drivers.memory_bench import MemoryDevice, MemoryDriver, memory_subject
from tests.variants import every_second, kept

REJECTED: tuple[tuple[type[MemoryDriver] | type[MemoryDevice], str], ...] = (
    (mutants.CloseLeavesOutputsOn, "close_leaves_zero"),
    (mutants.ConnectLeavesOutputsOn, "zero_after_connect"),
    (mutants.ZeroKeepsBias, "zero_after_connect"),
    (mutants.ZeroKeepsPositionLaw, "close_leaves_zero"),
    (mutants.ZeroForgetsLastJoint, "zero_after_connect"),
    (mutants.ZeroOnlyWhileStreaming, "spoiled_calls_raise_declared_errors"),
    (mutants.ZeroNeedsASession, "zero_after_lost_link"),
    (mutants.StartBringsLawsBack, "reset_drives_nothing"),
    (mutants.UploadBringsLawsBack, "zero_is_for_good"),
    (mutants.ReconnectResumesLaws, "session_again_has_no_laws"),
    (mutants.WatchdogNotSet, "silent_host_zeroes"),
    (mutants.LostHostUnnoticed, "lost_host_zeroes"),
    (mutants.ConnectClearsTrip, "trip_latches"),
    (mutants.StartClearsTrip, "trip_is_reported"),
    (mutants.TripDoesNotLatch, "trip_latches"),
    (mutants.TripUnmarked, "trip_is_reported"),
    (mutants.ResetResumesLaws, "reset_drives_nothing"),
    (mutants.ResetStopsTheStream, "reset_without_trip"),
    (mutants.SwallowsLoss, "cut_link_is_lost"),
    (mutants.RepeatsUnderNewNumber, "waveform_is_played"),
    (mutants.DropsUncounted, "samples_in_order"),
    (mutants.LostAnswerIsLostBlock, "spoiled_blocks_are_refused"),
    (mutants.StaleBlockAfterRestart, "second_stream_is_new"),
    (mutants.MadeUpBlock, "read_without_start"),
    (mutants.SequenceGoesOn, "second_stream_is_new"),
    (mutants.ApplyTickOffByOne, "waveform_is_played"),
    (mutants.BlockTickIsItsLast, "waveform_is_played"),
    (mutants.SaturationMissing, "saturation_is_marked"),
    (mutants.SaturationOfWholeBench, "saturation_is_marked"),
    (mutants.RestartIgnored, "waveform_is_played"),
    (mutants.AlwaysRestarts, "phase_is_kept_without_restart"),
    (mutants.StartKeepsPhase, "start_restarts_waveform"),
    (mutants.LimitIgnored, "limit_bounds_the_sum"),
    (mutants.LimitOfWaveformOnly, "limit_bounds_the_sum"),
    (mutants.LawsOfJointsSwapped, "trip_latches"),
    (mutants.UploadOverwritesFirst, "joints_are_separate"),
    (mutants.UploadActsAtOnce, "upload_waits_for_apply"),
    (mutants.UploadNeedsRestart, "random_calls"),
    (mutants.LongWaveformCut, "long_waveform_is_played"),
    (mutants.LawOfStoppedStreamLost, "stopped_stream_keeps_laws"),
    (mutants.NanTakenForOff, "impossible_laws_refused"),
    (mutants.RefusedLawHalfActs, "impossible_laws_refused"),
    (mutants.MissingLawsFilledUp, "impossible_laws_refused"),
    (mutants.RaisesValueError, "impossible_waveforms_refused"),
    (mutants.RaisesTimeoutError, "spoiled_calls_raise_declared_errors"),
    (mutants.CloseRaises, "other_rig_refused"),
    (mutants.OtherRigAccepted, "other_rig_refused"),
)


def test_the_correct_driver_passes_every_check() -> None:
    # `test_conformance` makes the whole effort of random calls on this bench.
    report = run(memory_subject(), effort=RandomCallBudget(10, 20, shorten=False))
    assert report.of(CheckVerdict.FAILED) == ()
    assert report.of(CheckVerdict.SKIPPED) == ()
    assert len(report.results) == len(all_checks()) > 40


@pytest.mark.parametrize(
    ("wrong", "check"), every_second(REJECTED), ids=lambda it: getattr(it, "__name__", "")
)
def test_each_wrong_driver_is_rejected_by_the_check_for_it(
    wrong: type[MemoryDriver] | type[MemoryDevice], check: str
) -> None:
    mutant = mutants.Mutant(wrong)
    report = run(memory_subject(mutant.driver, mutant.device), until_failure=True)
    (failed,) = report.of(CheckVerdict.FAILED)
    assert failed.check == check
    assert failed.reason
    assert "\n" not in failed.reason


def test_every_mutant_is_tried() -> None:
    here = {
        found
        for found in vars(mutants).values()
        if isinstance(found, type)
        and issubclass(found, MemoryDriver | MemoryDevice)
        and found not in (MemoryDriver, MemoryDevice)
    }
    assert here == {wrong for wrong, _ in REJECTED}
    assert len(here) >= 15


@pytest.mark.parametrize(
    "wrong",
    kept(
        [
            mutants.ZeroKeepsBias,
            mutants.CloseLeavesOutputsOn,
            mutants.WatchdogNotSet,
            mutants.TripDoesNotLatch,
            mutants.UploadActsAtOnce,
            mutants.DropsUncounted,
        ],
        (0, 2, 3, 5),
    ),
)
def test_random_calls_alone_find_it_and_name_the_calls(
    wrong: type[MemoryDriver] | type[MemoryDevice],
) -> None:
    mutant = mutants.Mutant(wrong)
    subject = memory_subject(mutant.driver, mutant.device)
    # Which calls are drawn depends on the modules loaded before; the first that fails ends it.
    effort = RandomCallBudget(sequences=300, shorten=False)
    report = run(subject, only=["random_calls"], effort=effort)
    (failed,) = report.of(CheckVerdict.FAILED)
    assert "(calls: " in failed.reason


def test_without_outputs_nothing_that_drives_is_asked_for() -> None:
    report = run(memory_subject(), outputs=False)
    drives = {check.name for check in all_checks() if check.moves}
    assert {result.check for result in report.of(CheckVerdict.SKIPPED)} == drives
    assert not report.of(CheckVerdict.FAILED)
    assert report.of(CheckVerdict.PASSED)


def test_an_unknown_check_is_refused() -> None:
    with pytest.raises(ValueError, match="no check is called 'levitation'; there are: identity"):
        run(memory_subject(), only=["levitation"])
