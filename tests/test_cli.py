import errno
import json
import subprocess
import sys

import pytest

from freqgs_plugin import cli
from freqgs_plugin.demo import run as demo_run


def test_help_lists_the_subcommands(capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main(["--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    assert all(name in text for name in cli.COMMANDS)


def test_import_is_light():
    heavy = ("torch", "numpy", "nerfstudio", "matplotlib", "cv2", "pycolmap")
    code = f"import sys, freqgs_plugin.cli; print([m for m in {heavy} if m in sys.modules])"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert out.strip() == "[]"


def test_scene_only_writes_a_scene_and_says_how_to_train(tmp_path, capsys):
    folder = tmp_path / "scene"
    cli.main(["demo", "--scene-only", str(folder), "--views", "3", "--size", "24", "16", "--seed", "5"])
    assert len(list((folder / "images").glob("*.png"))) == 3
    assert json.loads((folder / "freqgs-demo.json").read_text())["seed"] == 5
    assert "--colmap-path sparse/0" in capsys.readouterr().out
    assert [p.name for p in tmp_path.iterdir()] == ["scene"], "no other output"


@pytest.mark.parametrize("option", ["--scene-only", "--output-dir"])
def test_foreign_folders_are_refused_without_a_traceback(tmp_path, capsys, option):
    (tmp_path / "mine.txt").touch()
    with pytest.raises(SystemExit) as stop:
        cli.main(["demo", option, str(tmp_path)])
    assert stop.value.code == 1
    error = capsys.readouterr().err
    assert error.startswith("freqgs: ") and str(tmp_path) in error and "Nothing was changed" in error
    assert [p.name for p in tmp_path.iterdir()] == ["mine.txt"]


@pytest.mark.parametrize("arguments", [["--steps", "0"], ["--levels", "0"], ["--views", "1"]])
def test_impossible_options_are_refused(tmp_path, capsys, arguments):
    with pytest.raises(SystemExit) as stop:
        cli.main(["demo", "--output-dir", str(tmp_path / "out"), *arguments])
    assert stop.value.code == 1
    assert "at least" in capsys.readouterr().err


def test_unexpected_errors_keep_their_traceback(tmp_path, monkeypatch):
    monkeypatch.setattr(demo_run, "run_demo", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        cli.main(["demo", "--output-dir", str(tmp_path / "out")])


def test_a_full_disk_is_named(tmp_path, monkeypatch, capsys):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(demo_run, "run_demo", full)
    with pytest.raises(SystemExit) as stop:
        cli.main(["demo", "--output-dir", str(tmp_path / "out")])
    error = capsys.readouterr().err
    assert stop.value.code == 1 and "the disk is full" in error and "Make room" in error


@pytest.mark.parametrize(
    "command", [["bench", "raster", "--quick"], ["stability", "--quick"], ["experiment", "clod", "--views", "2"]]
)
def test_places_that_cannot_be_written_are_named_before_the_work(tmp_path, capsys, command):
    (tmp_path / "file").touch()
    with pytest.raises(SystemExit) as stop:
        cli.main([*command, "--output-dir", str(tmp_path / "file" / "out")])
    error = capsys.readouterr().err
    assert stop.value.code == 1 and "nothing can be written there" in error and str(tmp_path / "file" / "out") in error


def test_an_interrupt_says_how_to_go_on_and_exits_with_130(tmp_path, monkeypatch, capsys):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(demo_run, "train", interrupt)
    with pytest.raises(SystemExit) as stop:
        cli.main(["demo", "--output-dir", str(tmp_path / "out"), "--views", "2", "--size", "24", "16"])
    assert stop.value.code == 130
    assert "Stopped. The scene is kept in" in capsys.readouterr().out


@pytest.mark.slow
def test_demo_from_end_to_end(tmp_path, capsys):
    out = tmp_path / "out"
    cli.main(["demo", "--output-dir", str(out), "--steps", "60", "--views", "9", "--size", "64", "48", "--levels", "2"])
    report = json.loads((out / "report.json").read_text())
    assert [row["level"] for row in report["prefixes"]] == [1, 2]
    assert report["prefixes"][0]["psnr_own"] > 10
    assert report["views"] == {"train": 7, "test": 2}
    assert (out / "contact_sheet.png").stat().st_size > 5000
    assert "training level 2 of 2" not in (out / "train.log").read_text()
    assert "levels" in capsys.readouterr().out


def test_sigterm_leaves_nothing_half_written(tmp_path):
    """As a system that shuts down sends it: what was there stays, and nothing is left beside it."""
    code = f"""
import os, signal
from pathlib import Path
from freqgs_plugin import cli
from freqgs_plugin.reports.report import folder

def interrupted(path, contents, write=folder._write):
    write(path, contents)
    os.kill(os.getpid(), signal.SIGTERM)

def command() -> None:
    out = Path({str(tmp_path / "out")!r})
    folder.write_folder(out, {{"report.json": b'{{"files": ["a.txt"]}}', "a.txt": b"first"}})
    folder._write = interrupted
    folder.write_folder(out, {{"report.json": b"{{}}", "a.txt": b"second"}})

cli.COMMANDS = {{"one": command, "two": command}}
cli.main(["one"])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 143, done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    assert (tmp_path / "out" / "a.txt").read_text() == "first"
