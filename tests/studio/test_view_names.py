import pytest

from freqgs_plugin.studio.view_names import view_names


@pytest.mark.parametrize(
    ("files", "names"),
    [
        ([], []),
        (["/s/images/a.png", "/s/images/b.jpg"], ["a.png", "b.jpg"]),
        (["/s/images/left/1.png", "/s/images/right/2.png"], ["1.png", "2.png"]),
        (["/s/images/left/1.png", "/s/images/right/1.png"], ["left_1.png", "right_1.png"]),
        (["/s/i/1.png", "/s/i/x/1.png"], ["1.png", "x_1.png"]),
        (["/s/i/a.png", "/s/i/a.jpg"], ["a_png.png", "a_jpg.jpg"]),
        # trained on and held out
        (["/s/i/a.png", "/s/i/b.png", "/s/i/a.png"], ["a.png", "b.png", "a.png"]),
    ],
)
def test_names_tell_views_apart(files, names):
    assert view_names(files) == names
