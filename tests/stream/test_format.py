"""What is written comes back: exactly, or within half a step."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scenes_to_stream import small_scene

from freqgs_plugin.functional.attenuation import LevelCut
from freqgs_plugin.rendering.base import get_rasterizer
from freqgs_plugin.rendering.render import render
from freqgs_plugin.stream.errors import StreamError
from freqgs_plugin.stream.manifest import MANIFEST, parse_manifest
from freqgs_plugin.stream.order import importance, streaming_order
from freqgs_plugin.stream.quantise import VARIANTS, coding_of, decode_column, encode_column
from freqgs_plugin.stream.received import Received
from freqgs_plugin.stream.write import StreamOptions, encode_stream, write_stream

FINE = VARIANTS["fine"]


def back(name, values, steps):
    coding = coding_of(name, values, steps)
    data = encode_column(coding, values)
    assert len(data) == len(values) * coding.bytes_per_row
    return decode_column(coding, data, len(values)), coding


def numbers(width, low, high):
    return st.integers(1, 40).flatmap(
        lambda n: arrays(np.float32, (n, width), elements=st.floats(low, high, width=32, allow_subnormal=False))
    )


@settings(max_examples=15)
@given(numbers(4, -(2.0**100), 2.0**100))
def test_exact_is_bit_for_bit(values):
    found, _ = back("quats", values, None)
    assert np.array_equal(found.view(np.uint32), values.view(np.uint32))


@settings(max_examples=15)
@given(numbers(6, -4, 4))
def test_coefficients_are_within_half_a_step(values):
    found, _ = back("features_rest", values, FINE)
    assert np.abs(found - values).max() <= FINE.features_rest / 2 + 1e-6


@settings(max_examples=15)
@given(numbers(3, 2.0**-66, 2.0**20))
def test_scales_are_within_half_a_step_of_their_logarithm(values):
    found, coding = back("scales", values, FINE)
    assert np.abs(np.log(found) - np.log(values)).max() <= max(coding.step) / 2 + 1e-5
    assert max(coding.step) == FINE.scales


@settings(max_examples=15)
@given(numbers(1, 0, 1))
def test_opacities_are_within_half_a_step_of_their_logit(values):
    found, _ = back("opacities", values, FINE)
    # a logit's slope is at least 4
    assert np.abs(found - np.clip(values, 1 / (1 + np.exp(6)), 1 / (1 + np.exp(-8)))).max() <= FINE.opacities / 8 + 1e-6


@settings(max_examples=15)
@given(numbers(3, -1e4, 1e4))
def test_positions_have_sixteen_bits_in_their_box(values):
    found, coding = back("means", values, FINE)
    error = np.abs(found - values).max()
    # the steps are widest at the edge of the box
    farthest = np.abs(values - np.array(coding.centre)).max() + coding.scale
    assert error <= 0.55 * max(coding.step) * farthest * 1.5 + 1e-6 * np.abs(values).max()


@settings(max_examples=15)
@given(numbers(4, -3, 3).filter(lambda q: (np.abs(q).max(1) > 1e-3).all()))
def test_rotations_are_the_same_rotations(quats):
    found, _ = back("quats", quats, FINE)
    unit = quats / np.linalg.norm(quats.astype(np.float64), axis=1, keepdims=True)
    # q and -q are one rotation
    assert (1 - np.abs((unit * found).sum(1))).max() < 4 * FINE.quats**2
    assert np.allclose(np.linalg.norm(found, axis=1), 1, atol=1e-5)


def test_what_is_the_same_everywhere_takes_no_bytes():
    values = np.tile(np.float32([[0.3, -0.2, 0.0]]), (50, 1))
    for steps in (None, FINE):
        found, coding = back("features_dc", values, steps)
        assert coding.bytes_per_row == 0 and np.abs(found - values).max() <= (
            0 if steps is None else FINE.features_dc / 2
        )


def test_numbers_that_are_not_finite_are_refused():
    scene = small_scene(30)
    opacities = scene.gaussians.opacities.clone()
    opacities[3] = torch.nan
    with pytest.raises(StreamError, match="opacities of 1 of 10 Gaussians are not finite"):
        encode_stream(
            replace(scene, cameras=(), gaussians=replace(scene.gaussians, opacities=opacities)), StreamOptions()
        )


def whole(stream):
    received = Received(stream.manifest)
    for chunk in stream.manifest.chunks:
        received.add(chunk, stream.data[chunk.offset : chunk.offset + chunk.bytes])
    return received.gaussians()


@pytest.mark.parametrize("decay", [False, True])
def test_an_exact_stream_holds_every_bit(decay):
    scene = small_scene(decay=decay)
    found = whole(encode_stream(scene, StreamOptions("exact", 3)))
    order = _order(scene)
    expected = scene.gaussians.select(order)
    for name in ("means", "quats", "scales", "opacities", "features_dc", "features_rest", "level", *["decay"] * decay):
        assert torch.equal(getattr(found, name), getattr(expected, name).to(getattr(found, name).dtype)), name


def _order(scene):
    from freqgs_plugin.functional.attenuation import DistanceDecay

    decay = None if scene.scene_distance is None else DistanceDecay(1.0, "scene", scene.scene_distance)
    rasterizer = get_rasterizer("numba", "cpu", absgrad=False)
    found = importance(scene.gaussians, scene.cameras, rasterizer=rasterizer, antialiased=True, attenuation=decay)
    return streaming_order(found, scene.gaussians.level)


def picture(scene, gaussians, level=9):
    rasterizer = get_rasterizer("numba", "cpu", absgrad=False)
    camera = scene.cameras[0]
    with torch.no_grad():
        return render(gaussians, camera, LevelCut(level), rasterizer=rasterizer, background=scene.background).features


def test_error_falls_as_bytes_rise():
    scene = small_scene()
    own, errors, sizes = picture(scene, scene.gaussians), [], []
    for variant in ("small", "balanced", "fine", "exact"):
        stream = encode_stream(scene, StreamOptions(variant))
        errors.append(float((picture(scene, whole(stream)) - own).square().mean().sqrt()))
        sizes.append(len(stream.data))
    assert errors == sorted(errors, reverse=True) and sizes == sorted(sizes)
    assert errors[0] < 0.03 and errors[-1] < 1e-3


def test_any_part_is_a_scene_and_more_is_never_worse():
    scene = small_scene()
    stream = encode_stream(scene, StreamOptions("exact", 4))
    received, own = Received(stream.manifest), picture(scene, scene.gaussians)
    counts, errors = [], []
    for chunk in stream.manifest.chunks:
        received.add(chunk, stream.data[chunk.offset : chunk.offset + chunk.bytes])
        counts.append(received.count)
        errors.append(float((picture(scene, received.gaussians()) - own).square().mean()))
        base = [c for c in stream.manifest.chunks if c.level == 1]
        if chunk == base[-1]:
            shown = picture(scene, received.gaussians())
            assert torch.allclose(shown, picture(scene, scene.gaussians, 1), atol=2e-3)
    assert counts == sorted(counts) and counts[-1] == len(scene.gaussians)
    assert errors[-1] < 1e-6 and errors[-1] <= min(errors)
    levels = [chunk.level for chunk in stream.manifest.chunks]
    assert levels == sorted(levels)


def test_without_cameras_the_largest_come_first():
    scene = replace(small_scene(), cameras=())
    found = whole(encode_stream(scene, StreamOptions("exact")))
    base = found.select(found.level == 1)
    axes = base.scales.sort(-1).values
    size = base.opacities * axes[:, 1] * axes[:, 2]
    assert (size.diff() <= 0).all()


def test_damage_is_seen_and_nothing_is_taken():
    stream = encode_stream(small_scene(60), StreamOptions())
    chunk = stream.manifest.chunks[0]
    data = bytearray(stream.data[: chunk.bytes])
    data[5] ^= 1
    received = Received(stream.manifest)
    with pytest.raises(StreamError, match="checksum"):
        received.add(chunk, bytes(data))
    assert received.count == 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m.update(version=9), "version 9"),
        (lambda m: m.pop("chunks"), "damaged"),
        (lambda m: m["chunks"]["offset"].__setitem__(1, 3), "begins at byte 3"),
        (lambda m: m["levels"][1].update(first=0), "begins with row 0"),
        (lambda m: m.update(data="../secret"), "is called"),
        (lambda m: m["chunks"]["count"].__setitem__(0, 10**9), "outside of its level"),
    ],
)
def test_manifests_that_contradict_themselves_are_refused(change, message, tmp_path):
    found = json.loads(encode_stream(small_scene(60), StreamOptions()).manifest.text())
    change(found)
    with pytest.raises(StreamError, match=message):
        parse_manifest(json.dumps(found))


def test_a_stream_is_replaced_in_one_piece(tmp_path):
    for variant in ("small", "exact"):
        manifest = write_stream(replace(small_scene(60), cameras=()), tmp_path, StreamOptions(variant))
    assert sorted(p.name for p in tmp_path.iterdir()) == [MANIFEST, manifest.data]
    assert parse_manifest((tmp_path / MANIFEST).read_bytes()) == manifest
