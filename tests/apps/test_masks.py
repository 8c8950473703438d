"""Masks of objects: from a folder, from a box, from a point, and from one view to all."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from freqgs_plugin.apps.grabcut import mask_from_box, mask_from_point
from freqgs_plugin.apps.masks import MaskError, read_masks
from freqgs_plugin.apps.propagate import propagate, refine
from freqgs_plugin.demo.scene import look_at
from freqgs_plugin.rendering.base import get_rasterizer
from freqgs_plugin.rendering.render import render
from freqgs_plugin.types import Camera, Gaussians

NUMBA = get_rasterizer("numba", "cpu")
SIZE = (40, 30)


def view(width=SIZE[0], height=SIZE[1]):
    return Camera(torch.eye(4), torch.tensor([[30.0, 0, 20], [0, 30, 15], [0, 0, 1]]), width, height)


def write(path: Path, image):
    path.write_bytes(cv2.imencode(".png", np.asarray(image))[1].tobytes())


def square(top=10, left=12, side=8, value=255, shape=SIZE):
    mask = np.zeros(shape[::-1], np.uint8)
    mask[top : top + side, left : left + side] = value
    return mask


def overlap(first, second):
    return float((first & second).sum() / (first | second).sum())


def test_masks_are_found_by_their_views_names(tmp_path):
    write(tmp_path / "a.png", square(value=1))
    write(tmp_path / "b.jpg.png", square(left=3))
    write(tmp_path / "unrelated.png", square(shape=(5, 5)))
    (tmp_path / "notes.txt").write_text("a")
    found = read_masks(tmp_path, ["a.jpg", "b.jpg", "c.jpg"], [view()] * 3)
    assert sorted(found) == [0, 1]
    assert torch.equal(found[0], torch.from_numpy(square() > 0))
    assert torch.equal(found[1], torch.from_numpy(square(left=3) > 0))


@pytest.mark.parametrize("depth", [np.uint8, np.uint16])
def test_any_colour_is_the_object_and_what_is_transparent_is_not(tmp_path, depth):
    blue = np.zeros((*SIZE[::-1], 4), depth)
    blue[10:18, 12:20, 0] = 3
    blue[..., 3] = np.iinfo(depth).max
    blue[:, 16:, 3] = 0
    write(tmp_path / "a.png", blue)
    found = read_masks(tmp_path, ["a.png"], [view()])[0]
    expected = torch.from_numpy(square() > 0)
    expected[:, 16:] = False
    assert torch.equal(found, expected)


def test_an_empty_mask_says_that_the_object_is_not_seen(tmp_path):
    write(tmp_path / "a.png", square())
    write(tmp_path / "b.png", square(value=0))
    found = read_masks(tmp_path, ["a.png", "b.png"], [view()] * 2)
    assert found[0].any() and not found[1].any()


def test_bad_folders_are_named(tmp_path):
    def refused(message, names=("a.png", "b.png")):
        with pytest.raises(MaskError, match=message):
            read_masks(tmp_path / "masks", list(names), [view()] * len(names))

    refused("is no folder")
    (tmp_path / "masks").mkdir()
    refused("holds no .png file")
    (tmp_path / "masks" / "a.png").write_bytes(b"")
    refused(r"a\.png cannot be decoded")
    write(tmp_path / "masks" / "a.png", square(shape=(20, 10)))
    refused(r"a\.png is 20x10 px, and its view 40x30 px")
    write(tmp_path / "masks" / "a.png", square(value=0))
    refused("all 1 masks in .* are empty")
    refused("none of the 1 masks in .* masks are a, views x, y", ("x.png", "y.png"))


def disc_picture(radius=12, centre=(34, 28), size=(80, 60)):
    """A red disc on a striped ground, and its mask."""
    y, x = np.mgrid[: size[1], : size[0]]
    mask = (x - centre[0]) ** 2 + (y - centre[1]) ** 2 <= radius**2
    noise = np.random.default_rng(0).normal(0, 0.02, (*mask.shape, 3))
    ground = np.stack([0.5 + 0.1 * np.sin(x / 3), 0.6 + 0 * x, 0.7 + 0 * x], -1)
    image = np.where(mask[..., None], (0.8, 0.15, 0.1), ground) + noise
    return torch.from_numpy(np.clip(image, 0, 1).astype(np.float32)), torch.from_numpy(mask)


def test_a_box_is_cut_to_what_is_inside():
    image, mask = disc_picture()
    found = mask_from_box(image, (20, 14, 49, 43))
    assert overlap(found, mask) > 0.97
    assert torch.equal(mask_from_box(image, (20, 14, 49, 43)), found), "the same each time"
    # a part of it beyond the image
    image, mask = disc_picture(centre=(4, 28))
    assert overlap(mask_from_box(image, (-30, 14, 19, 43)), mask) > 0.95


@pytest.mark.parametrize("shift", [(0, 0), (-3, -2), (3, 2)])
@pytest.mark.parametrize("radius", [6, 12, 18])
def test_a_point_is_enough_for_something_clear(shift, radius):
    image, mask = disc_picture(radius)
    point = (34 + shift[0], 28 + shift[1])
    found = mask_from_point(image, point)
    assert overlap(found, mask) > 0.9
    assert torch.equal(mask_from_point(image, point), found), "the same each time"


def test_bad_boxes_and_points_are_named():
    image, _ = disc_picture()
    for box in ((90, 0, 95, 9), (30, 10, 30, 20), (30, 20, 40, 10)):
        with pytest.raises(MaskError, match="holds no pixel of the 80x60 image"):
            mask_from_box(image, box)
    for point in ((80, 5), (-1, 5), (5, 60)):
        with pytest.raises(MaskError, match="lies outside of the 80x60 image"):
            mask_from_point(image, point)
    with pytest.raises(MaskError, match="nothing stands out around the point"):
        mask_from_point(torch.full((60, 80, 3), 0.5), (40, 30))


def test_refining_moves_the_border_to_the_edge_in_the_picture():
    image, mask = (t.numpy() for t in disc_picture())
    picture = (image * 255).astype(np.uint8)
    drawn = np.roll(mask, 2, 1)
    everywhere = np.ones_like(mask)
    assert overlap(drawn, mask) < 0.85 < 0.95 < overlap(refine(picture, drawn, everywhere), mask)
    # into what nobody has seen it may grow farther
    part = mask & (np.arange(80) < 36)
    known = np.arange(80)[None] < 36
    far, near = refine(picture, part, known | ~mask), refine(picture, part, everywhere)
    assert overlap(near, mask) < overlap(far, mask)
    speck = np.zeros_like(mask)
    speck[3, 3] = True
    assert np.array_equal(refine(picture, speck, everywhere), speck)
    assert not refine(picture, mask & False, everywhere).any()


def orbit_scene(count=12):
    """A red ball on a grey floor, of small discs, and views around it."""
    g = torch.Generator().manual_seed(0)
    ball = torch.nn.functional.normalize(torch.randn(1500, 3, generator=g), dim=1) * 0.3
    floor = torch.cat([torch.rand(3000, 2, generator=g) * 3 - 1.5, torch.full((3000, 1), -0.32)], 1)
    means, n = torch.cat([ball, floor]), 4500
    red = torch.tensor([1.2, -1.2, -1.2]).expand(1500, 3)
    grey = torch.randn(3000, 1, generator=g).expand(3000, 3) * 0.4
    sizes = torch.full((n, 3), 0.03)
    scene = Gaussians(
        means, torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1), sizes, torch.full((n,), 0.95), torch.cat([red, grey]),
        torch.zeros(n, 0, 3), torch.ones(n, dtype=torch.long),
    )  # fmt: skip
    cameras = []
    for azimuth in np.arange(count) * 2 * np.pi / count:
        eye = np.array([1.6 * np.cos(azimuth), 1.6 * np.sin(azimuth), 0.9])
        cameras.append(look_at(eye, np.zeros(3), 96, 72))
    with torch.no_grad():
        images = [render(scene, camera, rasterizer=NUMBA).features.clamp(0, 1) for camera in cameras]
    return scene, cameras, images


@pytest.mark.parametrize("rounds", [0, 1])
def test_a_mask_goes_around_the_object(rounds):
    scene, cameras, images = orbit_scene()
    mask = mask_from_box(images[0], (30, 20, 67, 58))
    found, masks = propagate(scene, cameras, images, 0, mask, rasterizer=NUMBA, rounds=rounds)
    ball = torch.arange(len(scene)) < 1500
    assert torch.equal(masks[0], mask) and len(masks) == 12
    seen = found.total > 0
    assert overlap(found.rows & seen, ball & seen) > 0.95
    # from one view, half of it at most
    alone, _ = propagate(scene, cameras[:1], images[:1], 0, mask, rasterizer=NUMBA)
    assert int((alone.rows & ball).sum()) < 0.7 * int((found.rows & ball).sum())


def test_what_cannot_be_propagated_is_named():
    scene, cameras, images = orbit_scene(2)
    mask = torch.ones(72, 96, dtype=torch.bool)

    def refused(message, views=cameras, pictures=images, first=0, marked=mask, error=MaskError):
        with pytest.raises(error, match=message):
            propagate(scene, views, pictures, first, marked, rasterizer=NUMBA)

    refused("1 images for 2 views", pictures=images[:1])
    refused("first is 2; views are numbered from 0 to 1", first=2, error=ValueError)
    refused("the mask is empty", marked=~mask)
    refused("mask 0 is 96x71 px", marked=mask[1:])
    refused("image 1 is 96x71 px", pictures=[images[0], images[1][1:]])
    corner = torch.zeros_like(mask)
    corner[0, 0] = True
    refused("no Gaussian belongs to what the mask marks", marked=corner)
