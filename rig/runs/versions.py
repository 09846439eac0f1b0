"""Which software took a run: version, interpreter, platform and commit, for run.yaml."""

from __future__ import annotations

import platform
import subprocess
from importlib import metadata
from pathlib import Path

_ROOT = Path(__file__).resolve().parents[2]


def _git(*words: str) -> str | None:
    try:
        done = subprocess.run(
            ["git", "-C", str(_ROOT), *words],
            capture_output=True,
            text=True,
            timeout=5,
            check=True,
            stdin=subprocess.DEVNULL,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


def commit() -> str | None:
    """Return the commit of the source tree in use ('-dirty' if changed), None if installed."""
    if not (_ROOT / ".git").exists():
        return None
    head = _git("rev-parse", "HEAD")
    if not head:
        return None
    return f"{head}-dirty" if _git("status", "--porcelain", "--untracked-files=no") else head


def versions() -> dict[str, str]:
    """Return what a reader needs to take the same run again: software and where it ran."""
    try:
        version = metadata.version("bramah")
    except metadata.PackageNotFoundError:
        version = "unknown"
    found = {
        "bramah": version,
        "python": platform.python_version(),
        "platform": platform.platform(),
    }
    source = commit()
    return found if source is None else {**found, "commit": source}
