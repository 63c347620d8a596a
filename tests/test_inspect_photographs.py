"""The inspection of a folder of photographs that have no cameras yet."""

import pytest

from clsplat.errors import DataError
from clsplat.inspect.inspection import Inspection
from data_tools.gather import list_photographs
from tests.test_inspect import photograph, said


def texts(inspection: Inspection, level: str) -> list[str]:
    return [finding.text for finding in inspection.findings if finding.level == level]


def test_the_folder_that_was_asked_about_is_named_as_a_shell_reads_it(tmp_path):
    scene = tmp_path / "my ü"
    for name in ("one/a.png", "one/b.png", "two/c.png"):
        (scene / name).parent.mkdir(parents=True, exist_ok=True)
        photograph(scene / name)
    assert said(Inspection.of(scene), "error") == (
        f"{scene} holds 3 photographs but no camera poses: `clsplat run photos --scene '{scene}'` finds the cameras"
    )


def test_files_that_a_preparation_leaves_out_are_told_as_it_tells_them(tmp_path, caplog):
    for name in ("a.png", "b.png", "c.png"):
        photograph(tmp_path / name)
    for name in ("d.heic", "e.dng", "f.cr2"):
        (tmp_path / name).write_bytes(b"raw")
    (tmp_path / "g.jpg").write_text("text")
    inspection = Inspection.of(tmp_path)
    assert not caplog.records, "findings have it"
    list_photographs(tmp_path)
    warned = [record.getMessage().removeprefix(f"{tmp_path}: ") for record in caplog.records]
    assert len(warned) == 3
    damaged = "1 of 4 photographs cannot be read: g.jpg (not an image, or a damaged one); export them again"
    assert texts(inspection, "warning") == [*warned, damaged]


@pytest.mark.parametrize("names", [("a.heic",), ("a.png", "b.png"), ("a.png", "b.png", "c.heic")])
def test_too_few_are_refused_as_a_preparation_refuses_them(tmp_path, names):
    for name in names:
        photograph(tmp_path / name) if name.endswith("png") else (tmp_path / name).write_bytes(b"raw")
    inspection = Inspection.of(tmp_path)
    with pytest.raises(DataError) as refused:
        list_photographs(tmp_path)
    assert said(inspection, "error").endswith(str(refused.value).removeprefix(str(tmp_path)))
    assert not texts(inspection, "warning"), "the error says what to convert"


def test_three_of_which_one_is_damaged_are_too_few(tmp_path):
    for name in ("a.png", "b.png"):
        photograph(tmp_path / name)
    (tmp_path / "c.jpg").write_text("text")
    inspection = Inspection.of(tmp_path)
    assert said(inspection, "error").endswith("only 2 of 3 photographs can be read; export them again")
    assert said(inspection, "warning").startswith("1 of 3 photographs cannot be read: c.jpg")
