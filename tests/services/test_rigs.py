"""Somebody names a rig: by its shipped name, by a path, or wrongly."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

import pytest

from rig.model.parse import InputError
from rig.runs.rigs import load_rig, shipped_rigs

SEED = resources.files("rig").joinpath("shipped", "shinshu-2dof.yaml").read_text()


def test_a_shipped_rig_is_found_by_name_and_a_copy_of_it_by_path(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text(SEED)
    by_name = load_rig("shinshu-2dof")
    assert load_rig(tmp_path / "mine.yaml") == by_name
    assert load_rig("mine.yaml", relative_to=tmp_path) == by_name
    assert "shinshu-2dof" in shipped_rigs()


def test_a_misspelt_name_is_answered_with_the_names_there_are(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no such file.*shipped rig: .*shinshu-2dof") as error:
        load_rig("shinsu-2dof", relative_to=tmp_path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"name: \x00\x01\x02", "binary"),
        (b"\xff\xfe\xfa", "not UTF-8"),
        (b"# " + b"x" * (1 << 20), "larger than 1024 KiB"),
        (b"", ":1: the file is empty"),
        (b"a: [1, 2", ":1: not valid YAML"),
        (SEED.replace("stroke: 75 mm", "stroke: 75 kg").encode(), ":15: .*stroke"),
        (SEED.replace("stroke:", "strok:", 1).encode(), "strok: unknown key"),
    ],
)
def test_a_file_that_is_no_rig_is_refused_with_the_reason(
    tmp_path: Path, content: bytes, said: str
) -> None:
    path = tmp_path / "bad.yaml"
    path.write_bytes(content)
    with pytest.raises(InputError, match=said) as error:
        load_rig(path)
    assert str(path) in str(error.value)


def test_a_folder_a_device_and_an_impossible_path_are_refused(tmp_path: Path) -> None:
    for path, said in ((tmp_path, "is a folder"), (Path("/dev/zero"), "is not a regular file")):
        with pytest.raises(InputError, match=said) as error:
            load_rig(path)
        assert str(error.value).count("expected") == 1
    with pytest.raises(InputError):
        load_rig("a\0b")
    with pytest.raises(InputError):
        load_rig("x" * 5000)
