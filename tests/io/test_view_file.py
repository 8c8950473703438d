"""A view's file gives back what was written, or says that it is damaged."""

import errno
import os

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from freqgs_plugin.io import view_file
from freqgs_plugin.io.view_file import DamagedViewError, open_view, read_about, write_view

ABOUT = {"settings": {"number": 0.1, "name": "é"}, "camera": None}
TENSORS = {
    "image": torch.arange(5 * 7 * 3, dtype=torch.uint8).reshape(5, 7, 3),
    "mask": torch.arange(5 * 7).reshape(5, 7, 1) % 3 == 0,
}


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "a.view"
    assert write_view(path, ABOUT, TENSORS) == path.stat().st_size
    return path


def same(one, other):
    return one.keys() == other.keys() and all(
        one[k].dtype == other[k].dtype and one[k].shape == other[k].shape and torch.equal(one[k], other[k]) for k in one
    )


@given(
    arrays.arrays(
        st.sampled_from([np.uint8, np.float32, np.bool_, np.int64]),
        arrays.array_shapes(min_dims=0, max_dims=3, max_side=70),
        elements={"allow_nan": False},
    )
)
def test_any_tensor_comes_back(tmp_path_factory, array):
    path = tmp_path_factory.mktemp("views") / "a.view"
    tensors = {"first": torch.tensor([True]), "image": torch.as_tensor(array)}
    write_view(path, ABOUT, tensors)
    assert same(open_view(path, check=True), tensors) and read_about(path) == ABOUT


def test_a_cropped_image_comes_back(tmp_path):
    part = torch.arange(90.0).reshape(5, 6, 3)[1:4, 2:5]
    write_view(tmp_path / "a", {}, {"image": part})
    assert torch.equal(open_view(tmp_path / "a", check=True)["image"], part)


def test_tensors_outlive_their_file_and_do_not_write_into_it(file):
    before, tensors = file.read_bytes(), open_view(file, check=False)
    tensors["image"].add_(1)
    assert file.read_bytes() == before
    file.unlink()
    assert torch.equal(tensors["image"], TENSORS["image"] + 1) and torch.equal(tensors["mask"], TENSORS["mask"])


def test_every_truncation_is_seen_without_reading_the_tensors(file):
    size = file.stat().st_size
    for length in range(size - 1, -1, -1):
        os.truncate(file, length)
        with pytest.raises(DamagedViewError, match=r"a\.view is damaged"):
            read_about(file)


def test_every_altered_byte_is_seen(file):
    whole = file.read_bytes()
    for place in range(len(whole)):
        file.write_bytes(whole[:place] + bytes([whole[place] ^ 4]) + whole[place + 1 :])
        with pytest.raises(DamagedViewError, match=r"a\.view is damaged"):
            open_view(file, check=True)


@pytest.mark.parametrize(
    ("contents", "message"),
    [
        (b"", "it ends after 0 bytes"),
        (b"\x89PNG\r\n\x1a\n" + bytes(90), "no file of this kind: it begins with .*PNG"),
    ],
)
def test_other_files(tmp_path, contents, message):
    (tmp_path / "a").write_bytes(contents)
    with pytest.raises(DamagedViewError, match=message):
        read_about(tmp_path / "a")


def test_a_file_that_cannot_be_finished_leaves_the_old_one_and_nothing_beside_it(file, monkeypatch):
    before = file.read_bytes()

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(view_file.os, "replace", full)
    with pytest.raises(OSError, match="No space left"):
        write_view(file, {}, TENSORS)
    assert file.read_bytes() == before and [p.name for p in file.parent.iterdir()] == ["a.view"]
