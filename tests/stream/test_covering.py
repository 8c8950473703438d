"""A picture without holes early: which Gaussians of the base come first, and how much larger they are meanwhile."""

from dataclasses import replace

import pytest
import torch
from scenes_to_stream import small_scene

from freqgs_plugin.rendering.base import get_rasterizer
from freqgs_plugin.rendering.render import render
from freqgs_plugin.stream.covering import covering_order
from freqgs_plugin.stream.enlarging import MOST, enlargements, without_holes
from freqgs_plugin.stream.received import Received
from freqgs_plugin.stream.views import judging_views, reduced, widened
from freqgs_plugin.stream.write import StreamOptions, encode_stream

SCENE = small_scene(levels=1)
NUMBA = get_rasterizer("numba", "cpu", absgrad=False)


def draw(gaussians, camera):
    with torch.no_grad():
        return render(gaussians, camera, rasterizer=NUMBA, background=SCENE.background, depth=False)


def holes(gaussians, scale=1.0):
    """Share of pixels over all views that lack a tenth of the whole picture's alpha."""
    larger = replace(gaussians, scales=gaussians.scales * scale)
    pairs = [(draw(larger, camera).alpha, draw(SCENE.gaussians, camera).alpha) for camera in SCENE.cameras]
    return sum(1 - float(without_holes(a, whole).float().mean()) for a, whole in pairs) / len(pairs)


def test_the_order_holds_every_row_once_and_closes_holes_sooner_than_another():
    order = covering_order(SCENE.gaussians, SCENE.cameras, rasterizer=NUMBA, antialiased=True)
    assert sorted(order.tolist()) == list(range(len(SCENE.gaussians)))
    few = len(order) // 4
    others = torch.randperm(len(order), generator=torch.Generator().manual_seed(0))[:few]
    assert holes(SCENE.gaussians.select(order[:few])) < 0.7 * holes(SCENE.gaussians.select(others))


def test_hidden_gaussians_come_last():
    """Behind the camera nothing is covered."""
    gaussians, hidden = SCENE.gaussians, torch.tensor([3, 50, 500])
    means = gaussians.means.clone()
    means[hidden] = 1e4
    order = covering_order(replace(gaussians, means=means), SCENE.cameras, rasterizer=NUMBA, antialiased=True)
    assert set(hidden.tolist()) <= set(order[-len(order) // 2 :].tolist())


def test_a_part_is_enlarged_and_the_whole_is_not():
    order = covering_order(SCENE.gaussians, SCENE.cameras, rasterizer=NUMBA, antialiased=True)
    base, cuts = SCENE.gaussians.select(order), [60, 150, 300, len(order)]
    factors = enlargements(base, cuts, SCENE.cameras, draw)
    assert factors[-1] == 1.0 and factors == sorted(factors, reverse=True) and 1 < factors[0] <= MOST
    part = base.select(torch.arange(cuts[0]))
    assert holes(part, factors[0]) < 0.5 * holes(part)
    assert enlargements(base, cuts, [], draw) == [1.0] * len(cuts)


def test_what_was_received_is_as_large_as_the_manifest_says_until_the_base_is_there():
    stream = encode_stream(small_scene(n=4000, levels=1), StreamOptions("exact"))
    cores = [chunk for chunk in stream.manifest.chunks if chunk.part == "core"]
    assert len(cores) > 1 and cores[0].enlarge > 1 and cores[-1].enlarge == 1
    whole, received = Received(stream.manifest), Received(stream.manifest)
    for chunk in stream.manifest.chunks:
        whole.add(chunk, stream.data[chunk.offset : chunk.offset + chunk.bytes])
    first = cores[0]
    received.add(first, stream.data[first.offset : first.offset + first.bytes])
    found, expected = received.gaussians(), whole.gaussians().scales[: first.count]
    assert torch.allclose(found.scales, expected * first.enlarge)
    for chunk in cores[1:]:
        received.add(chunk, stream.data[chunk.offset : chunk.offset + chunk.bytes])
    assert torch.equal(received.gaussians().scales, whole.gaussians().scales)


def test_judging_views_see_more_around_the_same_middle():
    camera = SCENE.cameras[0]
    wide = widened(camera, 1.5)
    assert (wide.width, wide.height) == (round(1.5 * camera.width), round(1.5 * camera.height))
    assert float(wide.K[0, 2]) - wide.width / 2 == pytest.approx(float(camera.K[0, 2]) - camera.width / 2)
    assert torch.equal(wide.K[:2, :2], camera.K[:2, :2])
    half = reduced(camera, 2)
    assert half.width == camera.width // 2 and torch.equal(half.K[:2], camera.K[:2] / 2)
    assert len(judging_views([camera] * 10, 4)) == 4
