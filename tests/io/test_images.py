import cv2
import numpy as np
import pytest

from freqgs_plugin.io.images import read_image, read_image_float, to_uint8, write_image

RGB = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [10, 20, 30]]], dtype=np.uint8)


def test_png_round_trip_keeps_rgb_order(tmp_path):
    write_image(tmp_path / "a.png", RGB)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), RGB)
    from PIL import Image

    np.testing.assert_array_equal(np.array(Image.open(tmp_path / "a.png")), RGB)


def test_jpeg_is_close_and_endings_may_be_capital(tmp_path):
    image = np.full((16, 16, 3), (200, 100, 50), dtype=np.uint8)
    write_image(tmp_path / "a.JPG", image)
    assert np.abs(read_image(tmp_path / "a.JPG").astype(int) - image).max() <= 3


def test_floats_are_clipped_and_rounded(tmp_path):
    image = np.array([[[-0.5, 0.5, 1.5]]], dtype=np.float32)
    assert to_uint8(image).tolist() == [[[0, 128, 255]]]
    write_image(tmp_path / "a.png", image)
    np.testing.assert_allclose(read_image_float(tmp_path / "a.png"), [[[0, 128 / 255, 1]]], atol=1e-6)


def test_alpha_is_dropped(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), np.dstack([RGB[..., ::-1], np.full((2, 2), 7, np.uint8)]))
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), RGB)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "does not exist"),
        (b"", r"is empty \(0 bytes\)"),
        (b"not an image", "cannot be decoded"),
        (np.zeros((2, 2), np.uint8), "is grey"),
        (np.zeros((2, 2, 3), np.uint16), "16 bits per channel"),
    ],
)
def test_unreadable_images_are_named(tmp_path, content, message):
    path = tmp_path / "odd.png"
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content is not None:
        cv2.imwrite(str(path), content)
    with pytest.raises(ValueError, match=f"odd.png.*{message}"):
        read_image(path)


def test_what_cannot_be_written_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"a.gif.*\.png, \.jpg"):
        write_image(tmp_path / "a.gif", RGB)
    with pytest.raises(ValueError, match="no pixels"):
        write_image(tmp_path / "a.png", RGB[:0])
    with pytest.raises(ValueError, match="1 of 3 values"):
        write_image(tmp_path / "a.png", np.array([[[np.nan, 0, 1]]]))
    assert not list(tmp_path.iterdir())
