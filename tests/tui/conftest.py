"""Screens of tests have no bench: the verbs that they start are answered by a stand-in."""

from __future__ import annotations

import sys

import pytest

from rig.tui import jobs

NO_DEVICE = "import sys; sys.stderr.write('bramah: no device here\\n'); sys.exit(4)"


@pytest.fixture(autouse=True)
def verbs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Answer every verb as a bench would whose device is gone."""
    monkeypatch.setattr(jobs, "BRAMAH", (sys.executable, "-c", NO_DEVICE))
