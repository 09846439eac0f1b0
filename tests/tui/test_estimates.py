"""An operator watches the identification while the experiment runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import pytest

from rig.tui.following.link import TrackedPoint
from rig.tui.pages.estimates import half_widths, warnings_of
from tests.tui.glass import Machine, Recorded, endpoint, glass
from tests.tui.recorded import Bench, followed, run, tracked

SIZES = ((80, 24), (120, 40), (200, 60))


def series(widths: Sequence[float], left: Sequence[float]) -> list[TrackedPoint]:
    """b with these half intervals, and these residuals, every 2 s."""
    return [
        TrackedPoint(
            2.0 * k, {"b": [1.0 + 1e-6 * k, 1.0 - half, 1.0 + half]}, {"fluid": [share, 1.0]}
        )
        for k, (half, share) in enumerate(zip(widths, left, strict=True))
    ]


def experiment(*, bad: bool) -> Machine:
    views = run(Bench(), 15.0)
    record = Recorded(
        replace(followed(view), **tracked(view.device_time, bad=bad)) for view in views
    )
    return Machine({endpoint(): record})


@pytest.mark.parametrize("size", SIZES)
async def test_a_good_experiment_shows_intervals_and_residual_without_a_warning(
    size: tuple[int, int],
) -> None:
    async with glass(experiment(bad=False), size=size) as shown:
        await shown.press("8")
        assert "residual of flow, held out" in shown.text
        assert "axis in 1e6" in shown.text
        assert "not known yet: C_pp_1" in shown.text
        assert "± " in next(line for line in shown.lines if "2.3" in line and "95 %" in line)
        assert "does not shrink" not in shown.text
        assert "the residual grows" not in shown.text
        assert any("⠁" <= letter <= "⣿" for letter in shown.text), "a curve is drawn"


@pytest.mark.parametrize("size", SIZES)
async def test_a_bad_experiment_says_so_in_marked_sentences_within_its_first_minute(
    size: tuple[int, int],
) -> None:
    async with glass(experiment(bad=True), size=size) as shown:
        await shown.press("8")
        text = " ".join(line.strip(" ▲") for line in shown.lines)
        assert "flow: the residual grows, 3." in text
        assert "b: its interval does not shrink, ±12% at" in text
        assert sum(line.startswith(" ▲ ") for line in shown.lines) >= 3
        assert "SPACE STOP" in shown.lines[-1]


def test_a_steady_narrow_interval_and_a_steady_residual_are_no_warning() -> None:
    assert warnings_of(series([0.01] * 20, [0.2] * 20)) == []
    shrinking = [0.3 * k**-0.5 for k in range(1, 21)]
    assert warnings_of(series(shrinking, [0.3] * 3 + [0.1] * 17)) == []


def test_single_outliers_of_the_residual_are_no_warning() -> None:
    left = [0.03] * 20
    left[18] = left[19] = 0.4
    assert warnings_of(series([0.01] * 20, left)) == []


def test_a_model_that_says_less_than_half_is_a_warning_from_the_start() -> None:
    (said,) = warnings_of(series([0.01] * 5, [0.8] * 5))
    assert said.startswith("flow: 80% remains as residual")


def test_a_parameter_that_is_not_excited_now_is_not_judged() -> None:
    found = series([0.3] * 20, [0.1] * 20)
    still = [replace(point, values=found[0].values) for point in found]
    assert len(half_widths(still, "b")) == 1
    assert warnings_of(still) == []


def test_nothing_tracked_is_no_warning() -> None:
    assert warnings_of([]) == []
    assert warnings_of([TrackedPoint(1.0, {"b": [None, None, None]}, {})]) == []
