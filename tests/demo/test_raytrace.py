import numpy as np
import pytest

from freqgs_plugin.demo.raytrace import Lamp, Solid, Surface, World, depth_map, object_ids, pixel_rays, render_truth
from freqgs_plugin.demo.scene import ZOOM_TARGET, build_world, look_at, orbit, zoom_path
from freqgs_plugin.demo.shapes import intersect, surface
from freqgs_plugin.demo.textures import photo, solid

WHITE = (Surface(solid(0.8, 0.8, 0.8)),)
DARK = (Surface(solid(0.2, 0.2, 0.2)),)


def _world(*solids: Solid) -> World:
    room = Solid("room", "room", (0, 0, 0), (5, 5, 5), DARK)
    return World((room, *solids), Lamp((0.0, 0.0, 4.9), 1.0))


@pytest.mark.parametrize("kind", ["box", "sphere", "cylinder"])
def test_hits_lie_on_the_surface_and_are_the_nearest(kind):
    rng = np.random.default_rng(0)
    origin = np.array([3.0, -2.0, 1.5], dtype=np.float32)
    directions = (rng.uniform(-1, 1, (4000, 3)) - origin).astype(np.float32)
    t = intersect(kind, origin, directions)
    hit = np.isfinite(t)
    assert 0.3 < hit.mean()
    points = origin + t[hit, None] * directions[hit]
    x, y, z = np.abs(points.astype(np.float64)).T
    size = {
        "box": np.max([x, y, z], 0),
        "sphere": np.sqrt(x**2 + y**2 + z**2),
        "cylinder": np.maximum(np.hypot(x, y), z),
    }
    np.testing.assert_allclose(size[kind], 1, atol=1e-4)
    assert ((surface(kind, points).normal * directions[hit]).sum(1) < 1e-4).all()


def test_depth_of_a_wall_is_the_camera_z_of_the_plane():
    camera = look_at(np.array([0.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0]), 20, 10, fov=60)
    np.testing.assert_allclose(depth_map(_world(), camera), 5, rtol=1e-5)


def test_object_ids_cover_the_projected_disc_of_a_sphere():
    ball = Solid("ball", "sphere", (3, 0, 0), (0.5, 0.5, 0.5), WHITE)
    camera = look_at(np.array([-1.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0]), 101, 101, fov=40)
    ids = object_ids(_world(ball), camera)
    radius = float(camera.K[0, 0]) * np.tan(np.arcsin(0.5 / 4))
    assert (ids == 1).sum() == pytest.approx(np.pi * radius**2, rel=0.02)
    assert ids[50, 50] == 1 and ids[0, 0] == 0


def test_a_turned_flat_box_hides_what_lies_behind_it():
    card = Solid("card", "box", (2, 0, 0), (1.0, 0.01, 1.0), WHITE, yaw=90)
    camera = look_at(np.array([0.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0]), 31, 31, fov=30)
    assert (object_ids(_world(card), camera) == 1).all()
    np.testing.assert_allclose(depth_map(_world(card), camera), 1.99, rtol=1e-4)


def test_shadow_falls_under_a_ball_only():
    table = Solid("table", "box", (0, 0, -1), (2, 2, 0.1), WHITE)
    ball = Solid("ball", "sphere", (0, 0, 0.5), (0.3, 0.3, 0.3), WHITE)
    camera = look_at(np.array([2.5, 0.0, 0.3]), np.array([0.0, 0.0, -0.9]), 64, 64, fov=50)
    with_ball, without = (render_truth(_world(table, *more), camera) for more in ([ball], []))
    changed = np.abs(with_ball - without).max(2) > 0.1
    assert changed[32, 32]
    assert changed.mean() < 0.3


def test_pixel_centres_lie_at_one_half():
    camera = look_at(np.array([0.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0]), 3, 3, fov=60)
    _, directions = pixel_rays(camera)
    np.testing.assert_allclose(directions[4], [1, 0, 0], atol=1e-6)
    assert directions[5] @ [0, -1, 0] > 0.1, "x must grow to the right"
    assert directions[7] @ [0, 0, -1] > 0.1, "y must grow downwards"


def test_more_samples_converge_to_the_same_picture():
    world, camera = build_world(), orbit(8, 48, 36)[1]
    few, many = render_truth(world, camera, 3), render_truth(world, camera, 6)
    assert np.abs(few - many).mean() < 0.02
    assert 0 <= few.min() and few.max() <= 1


def test_photographs_need_no_network(monkeypatch):
    import socket

    def refuse(*args: object) -> None:
        raise AssertionError("network access")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    photo.cache_clear()
    assert len(build_world().solids) > 25


def test_mipmaps_keep_the_mean_and_far_views_do_not_alias():
    texture = photo("brick", repeat=True)
    np.testing.assert_allclose(texture.levels[-1].mean(), texture.image.mean(), atol=1e-3)
    uv = np.random.default_rng(0).uniform(0, 1, (500, 2)).astype(np.float32)
    near, far = (texture.sample(uv, np.full(500, s, dtype=np.float32)) for s in (1.0, 256.0))
    assert far.std() < 0.1 * near.std()


def test_the_scene_has_sizes_and_distances_of_a_wide_range():
    world = build_world()
    bounds = [s.bound for s in world.solids]
    assert max(bounds) / min(bounds) > 100
    assert len({s.name for s in world.solids}) == len(world.solids)
    item = next(s for s in world.solids if s.name == ZOOM_TARGET)
    path = zoom_path(world, 12, 32, 24)
    distances = [float(np.linalg.norm(c.centre.numpy() - item.centre)) for c in path]
    assert distances[-1] / distances[0] >= 10
    target = world.solids.index(item)
    for camera, distance in zip(path, distances, strict=True):
        assert (
            object_ids(world, look_at(camera.centre.numpy().astype(float), np.array(item.centre), 3, 3, fov=1))[1, 1]
            == target
        )
        assert depth_map(world, camera).min() > 0.1 * distance


def test_orbit_cameras_are_inside_of_the_room_and_not_inside_of_things():
    world = build_world()
    for camera in orbit(36, 32, 24):
        assert depth_map(world, camera).min() > 0.3
        assert len(np.unique(object_ids(world, camera))) > 4
