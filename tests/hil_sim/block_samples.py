"""The samples of a block of registers, read by numpy alone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rig.model.wire.registers import BlockLayout


def unpack_samples(
    data: bytes, layout: BlockLayout
) -> tuple[NDArray[np.uint16], NDArray[np.int16]]:
    """Return (AD codes (n, channels), DA codes (n, joints)); raises ValueError on a wrong size."""
    rows = np.frombuffer(data, ">u2").astype(np.uint16).reshape(layout.samples, layout.columns)
    return rows[:, : layout.channels], rows[:, layout.channels :].view(np.int16)
