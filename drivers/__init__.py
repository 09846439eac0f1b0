"""Bytes on a wire to blocks of SI samples, behind one interface (`drivers.base`)."""

from __future__ import annotations

from drivers.base import Driver
from drivers.registry import make_driver, wire_at

__all__ = ["Driver", "make_driver", "wire_at"]
