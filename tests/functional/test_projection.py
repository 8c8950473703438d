"""The projection against gsplat's own torch one, and where that one loses its digits."""

import pytest
import scenes
import torch
from reference import projection as gsplat_projection

from freqgs_plugin.functional.projection import project, rotation_rows

AWKWARD = scenes.awkward()
REGULAR = [name for name in AWKWARD if name not in ("needles", "zero_quaternion", "empty")]


def ours(splats, camera, blur=0.3):
    return project(splats.means, splats.quats, splats.scales, camera, blur)


@pytest.mark.parametrize("name", REGULAR)
def test_equals_gsplat(name, assert_close):
    splats, camera = AWKWARD[name]
    radii, means2d, depths, conics, compensations = gsplat_projection(splats, camera, 0.3)
    projected = ours(splats, camera)
    assert torch.equal(projected.radii, radii)
    assert torch.equal(projected.visible, radii > 0)
    assert_close(projected.depths, depths)
    seen = radii > 0
    assert_close(projected.means2d[seen], means2d[seen])
    assert_close(projected.conics[seen], conics[seen])
    assert_close(projected.compensation[seen], compensations[seen])


@pytest.mark.parametrize("quantity", ["means2d", "conics", "compensation", "depths"])
@pytest.mark.parametrize("name", ["plain", "off_centre", "rotated", "behind", "outside"])
def test_gradients_equal_gsplats(name, quantity, assert_close):
    splats, camera = AWKWARD[name]
    index = ("radii", "means2d", "depths", "conics", "compensation").index(quantity)
    a, b = (scenes.leaves_of(splats, torch.float64) for _ in range(2))
    theirs = gsplat_projection(b, camera, 0.3)
    values = getattr(ours(a, camera), quantity)
    seen = theirs[0] > 0
    weights = torch.randn(values[seen].shape, generator=scenes.generator(4), dtype=torch.float64)
    (values[seen] * weights).sum().backward()
    (theirs[index][seen] * weights).sum().backward()
    for key in ("means",) if quantity in ("means2d", "depths") else ("means", "quats", "scales"):
        assert_close(getattr(a, key).grad, getattr(b, key).grad, loosen=100, message=key)


def test_variances_are_the_covariances(assert_close):
    splats, camera = AWKWARD["rotated"]
    projected = ours(splats, camera)
    a, b, c = projected.conics.unbind(-1)
    det = a * c - b * b
    assert_close(projected.cov_xx, c / det, loosen=10)
    assert_close(projected.cov_yy, a / det, loosen=10)
    assert not projected.cov_xx.requires_grad and not projected.cov_yy.requires_grad


def test_needles_keep_their_digits_in_float32(assert_close):
    """(1e-6, 1e-6, 300): the difference a c - b^2 would leave nothing of the determinant."""
    splats, camera = AWKWARD["rotated"]
    scales = torch.tensor([1e-6, 1e-6, 300.0], dtype=torch.float64).expand(len(splats), 3).clone()
    exact = ours(scenes.replace(splats, scales=scales), camera)
    cut = scenes.leaves_of(scenes.replace(splats, scales=scales), torch.float32)
    single = ours(cut, scenes.cast(camera, torch.float32))
    relative = (single.conics.double() - exact.conics).norm(dim=-1) / exact.conics.norm(dim=-1)
    assert relative[exact.visible].median() < 1e-5
    assert relative[exact.visible].max() < 1e-3
    single.compensation.sum().backward()
    assert torch.isfinite(cut.scales.grad).all() and torch.isfinite(cut.quats.grad).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_rotations_do_not_depend_on_the_norm(dtype, assert_close):
    quats = torch.randn(20, 4, generator=scenes.generator(1), dtype=torch.float64)
    unit = torch.stack([torch.stack(row, -1) for row in rotation_rows(quats)], -2)
    identity = torch.eye(3, dtype=torch.float64).expand(20, 3, 3)
    assert_close(unit @ unit.mT, identity)
    for factor in (1e-18, 1e-12, 1e6, 1e18):
        rows = rotation_rows((quats * factor).to(dtype))
        assert_close(torch.stack([torch.stack(row, -1) for row in rows], -2), unit, message=str(factor))


def test_a_zero_quaternion_is_the_identity_without_gradient():
    quats = torch.zeros(1, 4, requires_grad=True)
    rows = rotation_rows(quats)
    assert torch.equal(torch.stack([torch.stack(row, -1) for row in rows], -2)[0], torch.eye(3))
    sum(entry.sum() for row in rows for entry in row).backward()
    assert torch.equal(quats.grad, torch.zeros(1, 4))


def test_gradient_of_a_tiny_quaternion_grows_with_its_inverse_norm():
    """d rotation / d q scales as 1 / |q|: large, but right."""
    direction = torch.tensor([[0.3, -0.5, 0.7, 0.2]], dtype=torch.float64)
    gradients = []
    for factor in (1.0, 1e-12):
        quats = (direction * factor).requires_grad_()
        rotation_rows(quats)[0][1].sum().backward()
        gradients.append(quats.grad * factor)
    torch.testing.assert_close(*gradients)


def test_a_point_without_blur_is_culled_and_has_no_gradient():
    splats, camera = AWKWARD["plain"]
    leaves = scenes.leaves_of(scenes.replace(splats, scales=torch.zeros_like(splats.scales)), torch.float64)
    projected = ours(leaves, camera, blur=0.0)
    assert not projected.visible.any() and not projected.compensation.any()
    (projected.conics.sum() + projected.compensation.sum()).backward()
    for key in ("means", "quats", "scales"):
        assert torch.isfinite(getattr(leaves, key).grad).all()


def test_gradcheck():
    splats, camera = scenes.splats(4), scenes.camera(angles=(0.3, 0.1, -0.2))
    leaves = scenes.leaves_of(splats, torch.float64)

    def f(means, quats, scales):
        projected = project(means, quats, scales, camera, 0.3)
        return projected.means2d, projected.conics, projected.compensation, projected.depths

    assert torch.autograd.gradcheck(f, (leaves.means, leaves.quats, leaves.scales))


def test_conventions():
    """Pixel centres lie at +0.5, y points down, the principal point is where the axis meets the image."""
    camera = scenes.camera(10, 6, focal=8.0, centre=(1.0, -2.0))
    camera.viewmat[:3, 3] = 0
    means = torch.tensor([[0.0, 0, 2], [0.5, 0, 2], [0, 0.5, 2]]).double()
    projected = project(means, torch.ones(3, 4).double(), torch.full((3, 3), 0.1).double(), camera, 0.3)
    torch.testing.assert_close(projected.means2d, torch.tensor([[6.0, 1.0], [8.0, 1.0], [6.0, 3.2]]).double())
