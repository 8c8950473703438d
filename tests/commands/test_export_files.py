"""All files of an export, or none."""

import pytest

from freqgs_plugin.commands.export_files import check_targets, put_in_place, staging, targets


def test_targets(tmp_path):
    assert targets(tmp_path, "splat.ply", "json") == [tmp_path / "splat.ply", tmp_path / "splat.ply.json"]
    assert targets(tmp_path, "levels", "json") == [tmp_path / "levels"]


def test_staging_leaves_nothing(tmp_path):
    with pytest.raises(RuntimeError), staging(tmp_path / "new" / "folder") as folder:
        (folder / "half").write_text("x")
        raise RuntimeError
    assert not (tmp_path / "new").exists()


def test_what_is_there_is_refused(tmp_path):
    (tmp_path / "a").write_text("old")
    with pytest.raises(FileExistsError, match="add --overwrite"):
        check_targets([tmp_path / "a"], overwrite=False)
    check_targets([tmp_path / "a"], overwrite=True)


def test_a_file_in_place_of_the_folder(tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(OSError, match="nothing can be written there"):
        check_targets([tmp_path / "file" / "a"], overwrite=False)


def test_old_files_stay_where_new_ones_fail(tmp_path):
    old = [tmp_path / "a", tmp_path / "b"]
    for path in old:
        path.write_text("old")
    (tmp_path / "new").write_text("new")
    with pytest.raises(FileNotFoundError):
        put_in_place([tmp_path / "new", tmp_path / "missing"], old)
    assert [path.read_text() for path in old] == ["old", "old"]


def test_folders_are_replaced(tmp_path):
    for name, text in (("levels", "old"), ("fresh", "new")):
        (tmp_path / name).mkdir()
        (tmp_path / name / text).write_text(text)
    put_in_place([tmp_path / "fresh"], [tmp_path / "levels"])
    assert [p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*")] == ["levels", "levels/new"]
