"""Photographs on disk take no memory, and nothing that happens to their files goes unnoticed."""

import errno
import gc
import os
import re
import threading
import time
import weakref
from pathlib import Path

import numpy as np
import pytest
import torch
from caching import equal, everything, files
from PIL import Image

from freqgs_plugin.io import view_file
from freqgs_plugin.io.view_file import read_about
from freqgs_plugin.studio import disk_views
from freqgs_plugin.studio.disk_views import CacheError, DiskViews


def test_no_more_photographs_than_threads_are_in_memory(manager, monkeypatch):
    made = manager()
    alive, most, lock = set(), [0], threading.Lock()
    read = type(made.train_dataset).get_data

    def get_data(dataset, index, **options):
        data = read(dataset, index, **options)
        with lock:
            alive.add(index)
            most[0] = max(most[0], len(alive))
        weakref.finalize(data["image"], alive.discard, index)
        return data

    monkeypatch.setattr(type(made.train_dataset), "get_data", get_data)
    views = made.cached_train
    gc.collect()
    assert not alive and 1 <= most[0] <= disk_views.WORKERS + 1
    # and afterwards a view is mapped only while somebody holds it
    image = views[0]["image"]
    mapped = weakref.ref(image.untyped_storage())
    assert views[0]["image"].data_ptr() != image.data_ptr()
    del image
    assert mapped() is None


def test_what_is_written_into_a_batch_is_not_written_into_the_file(manager):
    views = manager().cached_train
    before = views[0]["image"].clone()
    views[0]["image"].zero_()
    assert torch.equal(views[0]["image"], before)


def change_photograph(scene):
    path = scene / "images" / "view_001.png"
    image = np.array(Image.open(path))
    Image.fromarray(255 - image).save(path)
    os.utime(path, ns=(1, path.stat().st_mtime_ns + 10**9))


def test_a_changed_photograph_is_cached_anew_and_its_old_file_removed(manager, own_scene, tmp_path, said):
    everything(manager(data=own_scene))
    old = files(tmp_path)
    change_photograph(own_scene)
    said.clear()
    assert equal(everything(manager(data=own_scene)), everything(manager(data=own_scene, cache_images_where="memory")))
    assert len(files(tmp_path)) == 9 and len(set(files(tmp_path)) & set(old)) == 8
    assert any("1 written" in line and "1 files that no run can use any more" in line for line in said)


def test_another_split_shares_the_files(manager, tmp_path, said):
    everything(manager())
    said.clear()
    everything(manager(parser={"eval_interval": 3}))
    assert len(files(tmp_path)) == 9 and sum(" 0 written" in line for line in said) == 2


@pytest.mark.parametrize("when", ["between runs", "in a run"])
@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda file: os.truncate(file, 3000), r"\.view is damaged: it has 3000 bytes instead of 1"),
        (lambda file: file.write_bytes(file.read_bytes()[:-9] + b"123456789"), "its checksum is another one"),
        (lambda file: file.write_bytes(b""), "it ends after 0 bytes"),
        (Path.unlink, "No such file|6 were there"),
    ],
)
def test_damaged_files_are_written_again(manager, tmp_path, said, spoil, message, when):
    made = manager()
    expected = [view["image"].clone() for view in manager(cache_images_where="memory").cached_train]
    views = made.cached_train
    for file in files(tmp_path):
        spoil(file)
    if when == "between runs":
        views = manager().cached_train
    said.clear() if when == "in a run" else None
    assert all(torch.equal(view["image"], image) for view, image in zip(views, expected, strict=True))
    assert any(re.search(message, line) for line in said) or (when == "between runs" and spoil is Path.unlink)
    for file in files(tmp_path):
        assert view_file.open_view(file, check=True) and read_about(file)


def test_a_photograph_that_changes_in_a_run_is_not_taken_for_the_old_one(manager, own_scene, tmp_path):
    views = manager(data=own_scene).cached_train
    change_photograph(own_scene)
    for file in files(tmp_path):
        file.unlink()
    with pytest.raises(ValueError, match=r"view_001.png has changed since the run began; start the run again"):
        list(views)


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS])
def test_a_disk_that_takes_no_more(manager, monkeypatch, tmp_path, number):
    replaced, calls = os.replace, []

    def replace(*paths):
        calls.append(paths)
        if len(calls) > 3:
            raise OSError(number, os.strerror(number))
        replaced(*paths)

    monkeypatch.setattr(view_file.os, "replace", replace)
    message = rf"cached in .*scene-.*: .*{os.strerror(number)}.*cache-images-dir.*cache-images-where memory"
    with pytest.raises(CacheError, match=message):
        manager().cached_train  # noqa: B018
    assert [p.name for p in (tmp_path / "cache").rglob("*") if p.is_file() and p.name != "writing.lock"] == []


def test_too_little_room_is_said_before_anything_is_written(manager, monkeypatch, tmp_path):
    class Usage:
        free = 1000

    monkeypatch.setattr(disk_views.shutil, "disk_usage", lambda _: Usage)
    with pytest.raises(CacheError, match=r"0\.1 MB are needed, and 0\.0 MB are free"):
        manager().cached_train  # noqa: B018
    assert not files(tmp_path)


def test_a_folder_that_cannot_be_made(manager, tmp_path):
    (tmp_path / "cache").write_text("a file")
    with pytest.raises(CacheError, match=r"cached in .*cache/scene-.*Not a directory.*cache-images-dir"):
        manager().cached_train  # noqa: B018


def test_a_damaged_photograph_is_not_blamed_on_the_disk(manager, own_scene):
    made = manager(data=own_scene)
    (own_scene / "images" / "view_001.png").write_bytes(b"no picture")
    with pytest.raises(OSError, match="cannot identify image file"):
        made.cached_train  # noqa: B018


def test_two_at_once_write_each_view_once(manager, monkeypatch, tmp_path, said):
    datasets, wrote, results = [manager().train_dataset for _ in range(2)], [], []
    write = disk_views.write_view

    def slowly(path, *rest):
        wrote.append(path)
        time.sleep(0.05)
        return write(path, *rest)

    def read(dataset):
        # not through the datamanager: before Python 3.12, cached properties of a class lock each other
        results.append([view["image"] for view in DiskViews(dataset, "uint8", tmp_path / "cache")])

    monkeypatch.setattr(disk_views, "write_view", slowly)
    threads = [threading.Thread(target=read, args=(dataset,)) for dataset in datasets]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(wrote) == len(set(wrote)) == 6 and equal(*results)
    assert any(line.startswith("Another process is caching photographs in ") for line in said)


def test_leftovers_of_a_killed_process_are_removed(manager, tmp_path):
    everything(manager())
    left = files(tmp_path)[0].parent / "0123.view.part"
    left.write_bytes(b"x" * 100)
    files(tmp_path)[0].unlink()
    everything(manager())
    assert not left.exists() and len(files(tmp_path)) == 9
