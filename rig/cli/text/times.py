"""Times on the command line."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

from rig.model.parse import InputError


def since(text: str, now: datetime) -> datetime:
    """Read a date, a time, or a duration before `now` (12h, 7d, 30m); raises InputError."""
    units = {"h": "hours", "d": "days", "m": "minutes"}
    if text[:-1].isdigit() and text[-1] in units:
        return now - timedelta(**{units[text[-1]]: int(text[:-1])})
    try:
        return datetime.fromisoformat(text).astimezone(UTC)
    except ValueError:
        raise InputError(
            f"--since {text!r}: expected a date (2026-03-01), a time (2026-03-01T22:00) or a "
            "duration (12h or 7d)"
        ) from None
