"""The figures of scale are measured as they say, on a hundredth of the rows."""

from __future__ import annotations

from pathlib import Path

import pytest

from rig.cli.bench.stream import row_figures


@pytest.mark.slow
def test_rows_stream_in_little_memory_to_numpy_s_solution(tmp_path: Path) -> None:
    large = bytearray(1 << 30)  # memory of the caller does not count
    found = row_figures(tmp_path, rows=100_001)
    del large
    assert found["rows"] == 100_001
    assert found["difference"] < 1e-10
    assert 0 < found["stream_peak_bytes"] < 1e9
    assert found["ratio"] > 0
    assert not list(tmp_path.iterdir())
