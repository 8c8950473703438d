import numpy as np
import pytest

from freqgs_plugin.apps.gaze import gaze_points, salient_point


def test_one_gaze_for_all_frames():
    assert gaze_points("0.25, 0.75", 3) == [(0.25, 0.75)] * 3
    assert gaze_points("1,0", 1) == [(1.0, 0.0)]
    assert gaze_points("auto", 2) == [None, None]


def test_a_file_of_gazes(tmp_path):
    (tmp_path / "lines.txt").write_text("0.1,0.2\n\n0.3 0.4\n")
    (tmp_path / "pairs.json").write_text("[[0.1, 0.2], [0.3, 0.4]]")
    (tmp_path / "one.txt").write_text("0.5,0.5\n")
    for name in ("lines.txt", "pairs.json"):
        assert gaze_points(str(tmp_path / name), 2) == [(0.1, 0.2), (0.3, 0.4)]
    assert gaze_points(str(tmp_path / "one.txt"), 4) == [(0.5, 0.5)] * 4
    with pytest.raises(ValueError, match="2 gazes for 5 frames"):
        gaze_points(str(tmp_path / "lines.txt"), 5)


@pytest.mark.parametrize("text", ["1.1,0.5", "-0.1,0.5", "0.5,2"])
def test_outside_of_the_image(text):
    with pytest.raises(ValueError, match="outside of the image"):
        gaze_points(text, 1)


def test_what_cannot_be_read(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nowhere\.txt"):
        gaze_points("nowhere.txt", 1)
    for content, message in (
        ("", "is empty"),
        ("0.1;0.2", "line 1"),
        ("0.1,0.2\nx", "line 2"),
        ("[[1, 2, 3]]", "line 1"),
    ):
        (tmp_path / "bad.txt").write_text(content)
        with pytest.raises(ValueError, match=message):
            gaze_points(str(tmp_path / "bad.txt"), 2)
    (tmp_path / "bad.txt").write_bytes(b"\xff\xfe")
    with pytest.raises(ValueError, match=r"bad\.txt is no text"):
        gaze_points(str(tmp_path / "bad.txt"), 2)
    (tmp_path / "bad.txt").write_text("x" * 1000)
    with pytest.raises(ValueError, match=r"x{40}'; it must be"):
        gaze_points(str(tmp_path / "bad.txt"), 2)


@pytest.mark.parametrize("place", [(20, 30), (60, 90), (40, 15)])
def test_the_salient_place_is_what_stands_out(place):
    picture = np.full((80, 120, 3), 0.4)
    y, x = place
    picture[y - 4 : y + 4, x - 4 : x + 4] = (0.9, 0.1, 0.1)
    u, v = salient_point(picture)
    assert abs(u * 120 - x) < 8 and abs(v * 80 - y) < 8


def test_without_contrast_the_middle():
    assert salient_point(np.full((30, 50, 3), 0.7)) == (0.5, 0.5)
