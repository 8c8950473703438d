"""The plain reader agrees with the writer, and with gsplat's own colours."""

import pytest
import torch
from gsplat.cuda._torch_impl import _spherical_harmonics

from freqgs_plugin.io.parameters import RawGaussians
from freqgs_plugin.io.plain_ply import read_plain
from freqgs_plugin.io.ply import write_ply
from freqgs_plugin.types import Camera


def raw(n=20, degree=3, **more):
    generator = torch.Generator().manual_seed(1)

    def normal(*shape):
        return torch.randn(*shape, generator=generator)

    k = (degree + 1) ** 2 - 1
    return RawGaussians(normal(n, 3), normal(n, 3), normal(n, 4), normal(n, 3), normal(n, k, 3), normal(n, 1), **more)


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_values(tmp_path, degree):
    gaussians = raw(degree=degree, level=torch.arange(20).int() % 2 + 1, decay=torch.ones(20))
    write_ply(tmp_path / "a.ply", gaussians, antialiased=True)
    scene = read_plain(tmp_path / "a.ply")
    assert len(scene) == 20 and scene.mip is True
    assert torch.equal(scene.means, gaussians.means) and torch.equal(scene.quats, gaussians.quats)
    assert torch.equal(scene.scales, gaussians.scales.exp())
    assert torch.equal(scene.opacities, gaussians.opacities[:, 0].sigmoid())
    assert torch.equal(scene.harmonics, torch.cat([gaussians.features_dc[:, None], gaussians.features_rest], 1))


@pytest.mark.parametrize(("antialiased", "mip"), [(None, None), (False, False), (True, True)])
def test_mode(tmp_path, antialiased, mip):
    write_ply(tmp_path / "a.ply", raw(), antialiased=antialiased)
    assert read_plain(tmp_path / "a.ply").mip is mip


def test_colours_are_those_of_gsplat(tmp_path, assert_close):
    write_ply(tmp_path / "a.ply", raw())
    scene = read_plain(tmp_path / "a.ply")
    viewmat = torch.eye(4)
    viewmat[:3, 3] = torch.tensor([0.3, -0.2, 5.0])
    camera = Camera(viewmat, torch.eye(3), 10, 10)
    theirs = _spherical_harmonics(3, scene.means - camera.centre, scene.harmonics)
    colours = scene.splats(camera).features
    assert_close(colours, (theirs + 0.5).clamp_min(0))
    assert (colours == 0).any()


def test_truncated(tmp_path):
    path = tmp_path / "a.ply"
    write_ply(path, raw())
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(ValueError, match="shorter than its header says"):
        read_plain(path)
    path.write_bytes(b"no ply")
    with pytest.raises(ValueError, match="no binary little-endian PLY"):
        read_plain(path)
