import dataclasses
import os

import av
import numpy as np
import pytest

from freqgs_plugin.commands.frames import LONGEST, RECORD, FrameFolder, FrameRecord, check_rate, write_video
from freqgs_plugin.io.images import read_image, write_image


def picture(seed=0, height=32, width=48):
    return np.random.default_rng(seed).random((height, width, 3)).astype(np.float32)


def test_a_second_start_finds_its_frames(tmp_path):
    folder = FrameFolder(tmp_path / "out", {"level": 1.0})
    folder.add(FrameRecord("a", 10, 1.5, (0.5, 0.5)), picture())
    folder.add(FrameRecord("b", 20, 2.5), picture(1))
    again = FrameFolder(tmp_path / "out", {"level": 1.0})
    assert set(again.records) == {"a", "b"} and again.records["b"].drawn == 20
    folder.path("a").unlink()
    assert set(FrameFolder(tmp_path / "out", {"level": 1.0}).records) == {"b"}


def test_frames_of_other_settings_stay(tmp_path):
    FrameFolder(tmp_path, {"level": 1.0}).add(FrameRecord("a", 10, 1.5), picture())
    before = read_image(tmp_path / "a.png")
    with pytest.raises(FileExistsError, match="other settings"):
        FrameFolder(tmp_path, {"level": 2.0})
    assert (read_image(tmp_path / "a.png") == before).all()


def test_pictures_that_are_no_frames_stay(tmp_path):
    """As in the folder of the photographs, which are called like the views."""
    write_image(tmp_path / "a.png", picture())
    before = (tmp_path / "a.png").read_bytes()
    with pytest.raises(FileExistsError, match=r"a\.png is there already, and no frames\.json says"):
        FrameFolder(tmp_path, {}, ["b.png", "a.png"])
    assert (tmp_path / "a.png").read_bytes() == before and not (tmp_path / RECORD).exists()
    FrameFolder(tmp_path, {}, ["b.png"])


def test_a_frame_is_recorded_before_it_is_there(tmp_path, monkeypatch):
    """Else a second start after a stop between the two would take it for a picture that is no frame."""
    folder = FrameFolder(tmp_path, {}, ["a.png"])
    monkeypatch.setattr("freqgs_plugin.commands.frames.write_image", stop)
    with pytest.raises(KeyboardInterrupt):
        folder.add(FrameRecord("a", 10, 1.5), picture())
    assert [path.name for path in tmp_path.iterdir()] == [RECORD]
    assert FrameFolder(tmp_path, {}, ["a.png"]).records == {}


def stop(path, image):
    path.write_bytes(b"half")
    raise KeyboardInterrupt


def test_a_budget_is_kept_with_its_frames(tmp_path):
    folder = FrameFolder(tmp_path, {"budget": "16ms"})
    assert folder.budget is None
    folder.budget = 1234
    folder.add(FrameRecord("a", 10, 1.5), picture())
    assert FrameFolder(tmp_path, {"budget": "16ms"}).budget == 1234


BAD_BUDGET = '{"frames": [], "budget": "many"}'


@pytest.mark.parametrize("content", ["", "{", "[]", '{"frames": [{"name": "a"}]}', '{"frames": 3}', BAD_BUDGET])
def test_a_damaged_record_is_named(tmp_path, content):
    (tmp_path / RECORD).write_text(content)
    with pytest.raises(FileExistsError, match="damaged"):
        FrameFolder(tmp_path, {})


def test_a_frame_that_is_not_finite_is_not_written(tmp_path):
    folder = FrameFolder(tmp_path, {})
    broken = picture()
    broken[0, 0, 0] = np.nan
    with pytest.raises(ValueError, match="not finite"):
        folder.add(FrameRecord("a", 1, 1.0), broken)
    assert not list(tmp_path.glob("*.png"))


@pytest.mark.parametrize("size", [(32, 48), (33, 47)])
def test_a_video_shows_the_frames(tmp_path, size):
    height, width = size
    x, y = np.meshgrid(np.linspace(0, 1, width), np.linspace(0, 1, height))
    frames = []
    for i in range(5):
        # smooth: a video halves the resolution of colours
        write_image(tmp_path / f"{i}.png", np.stack([x, y, np.full_like(x, i / 5)], -1))
        frames.append(tmp_path / f"{i}.png")
    write_video(tmp_path / "v.mp4", frames, 12.5)
    with av.open(str(tmp_path / "v.mp4")) as video:
        stream = video.streams.video[0]
        assert stream.codec_context.name == "h264" and float(stream.average_rate) == 12.5
        shown = [frame.to_ndarray(format="rgb24") for frame in video.decode(stream)]
    assert len(shown) == 5
    for frame, path in zip(shown, frames, strict=True):
        expected = read_image(path).astype(float)
        assert np.abs(frame[:height, :width] - expected).mean() < 6
    assert not list(tmp_path.glob(".*"))


def test_a_video_has_one_size(tmp_path):
    for name, width in (("a", 48), ("b", 46)):
        write_image(tmp_path / f"{name}.png", picture(width=width))
    with pytest.raises(ValueError, match=r"b\.png is 46x32 px"):
        write_video(tmp_path / "v.mp4", [tmp_path / "a.png", tmp_path / "b.png"], 24)
    assert not (tmp_path / "v.mp4").exists()
    with pytest.raises(ValueError, match="no frames"):
        write_video(tmp_path / "v.mp4", [], 24)


def test_a_video_that_fails_leaves_nothing(tmp_path, monkeypatch):
    write_image(tmp_path / "a.png", picture())
    monkeypatch.setattr(os, "replace", lambda *paths: stop(tmp_path / ".other", None))
    with pytest.raises(KeyboardInterrupt):
        write_video(tmp_path / "v.mp4", [tmp_path / "a.png"], 24)
    assert sorted(path.name for path in tmp_path.iterdir()) == [".other", "a.png"]


def test_the_longest_side_of_a_video(tmp_path):
    write_image(tmp_path / "a.png", np.zeros((16, LONGEST, 3), np.uint8))
    write_video(tmp_path / "v.mp4", [tmp_path / "a.png"], 24)
    assert (tmp_path / "v.mp4").stat().st_size > 0


@pytest.mark.parametrize("fps", [0, -1, 1e-4, 1e308, float("nan"), float("inf")])
def test_a_rate_that_no_video_has(fps):
    with pytest.raises(ValueError, match=r"fps is .* from 0\.01 to 1000"):
        check_rate(fps)


def test_records_are_plain():
    assert dataclasses.asdict(FrameRecord("a", 1, 2.0))["gaze"] is None
