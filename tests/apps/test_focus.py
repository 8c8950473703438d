import dataclasses

import pytest
import torch
from scenes import camera, splats

from freqgs_plugin.apps.focus import Focus, selection_picture, vote, vote_by_centres
from freqgs_plugin.apps.masks import MaskError
from freqgs_plugin.apps.visibility import view_weights
from freqgs_plugin.functional.attenuation import Attenuation, LevelCut, Product
from freqgs_plugin.rendering.base import get_rasterizer
from freqgs_plugin.rendering.render import render, rendered_weight
from freqgs_plugin.types import Gaussians

TORCH = get_rasterizer("torch", "cpu")
VIEW = camera()


def scene(n=120, levels=3, seed=0, dtype=torch.float64):
    s = splats(n, seed=seed, dtype=dtype)
    rest = torch.zeros(n, 0, 3, dtype=dtype)
    return Gaussians(s.means, s.quats, s.scales, s.opacities, s.features, rest, torch.arange(n) % levels + 1)


def balls(*places, sizes=0.1, opacity=0.95):
    """Round Gaussians at pixel x, y and camera z of `VIEW`; `sizes` in world units at depth 1, one for all or each."""
    n = len(places)
    intrinsics, z = VIEW.K, torch.tensor([p[2] for p in places], dtype=torch.float64)
    pixel = torch.tensor([[*p[:2], 1.0] for p in places], dtype=torch.float64)
    means = (pixel @ torch.linalg.inv(intrinsics).T) * z[:, None] - VIEW.viewmat[:3, 3]
    quats = torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64).repeat(n, 1)
    zeros = torch.zeros(n, 3, dtype=torch.float64)
    scales = (torch.as_tensor(sizes) * z)[:, None].expand(n, 3).contiguous()
    return Gaussians(
        means,
        quats,
        scales,
        torch.full((n,), opacity, dtype=torch.float64),
        zeros,
        zeros[:, None][:, :0],
        torch.ones(n).long(),
    )


def left_half(view=VIEW):
    return (torch.arange(view.width) < view.width // 2).expand(view.height, view.width)


def select(gaussians, cameras, masks, **options):
    return vote(gaussians, cameras, masks, rasterizer=options.pop("rasterizer", TORCH), **options)


def test_inside_and_outside_together_are_the_rendered_weight():
    g, mask = scene(dtype=torch.float32), left_half()
    found = select(g, [VIEW], [mask], visible=0)
    other = select(g, [VIEW], [~mask], visible=0)
    torch.testing.assert_close(found.total.float(), rendered_weight(g, VIEW, 1, rasterizer=TORCH))
    torch.testing.assert_close(found.inside + other.inside, found.total, rtol=1e-5, atol=1e-5)
    assert torch.equal(found.rows, found.inside > 0.5 * found.total) and 0 < found.count < len(g)


def test_the_weight_inside_is_what_the_gaussian_adds_to_the_masks_pixels():
    """By the linearity of compositing: a picture of one Gaussian's feature, summed over the mask."""
    g, mask = scene(30), left_half()
    inside = select(g, [VIEW], [mask], visible=0).inside
    for row in (0, 7, 19):
        alone = torch.arange(30) == row
        share = selection_picture(g, alone, VIEW, rasterizer=TORCH)
        alpha = render(g, VIEW, rasterizer=TORCH).alpha[..., 0]
        assert float((share * alpha)[mask].sum()) == pytest.approx(float(inside[row]), rel=1e-9)


def test_backends_agree():
    g, views = scene(dtype=torch.float32), [VIEW, camera(angles=(0.1, -0.2, 0.3))]
    masks = [left_half(), left_half()]
    by_torch, by_numba = (select(g, views, masks, rasterizer=get_rasterizer(b, "cpu")) for b in ("torch", "numba"))
    torch.testing.assert_close(by_numba.inside, by_torch.inside, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(by_numba.total, by_torch.total, rtol=1e-4, atol=1e-4)
    assert torch.equal(by_numba.rows, by_torch.rows)


def test_votes_of_views_add_up_in_any_order():
    g, views = scene(), [VIEW, camera(angles=(0.1, -0.2, 0.3)), camera(angles=(-0.2, 0.1, 0.0))]
    masks = [left_half(), ~left_half(), left_half()]
    found, turned = select(g, views, masks), select(g, views[::-1], masks[::-1])
    each = [select(g, [view], [mask]) for view, mask in zip(views, masks, strict=True)]
    torch.testing.assert_close(found.inside, sum(e.inside for e in each))
    torch.testing.assert_close(turned.total, found.total)
    assert torch.equal(turned.rows, found.rows)


def test_the_order_of_gaussians_does_not_matter():
    g = scene()
    order = torch.randperm(len(g), generator=torch.Generator().manual_seed(3))
    assert torch.equal(
        select(g.select(order), [VIEW], [left_half()]).rows, select(g, [VIEW], [left_half()]).rows[order]
    )


def test_what_hides_behind_the_object_does_not_belong_to_it():
    """A stack of large discs and a small one behind them, which light reaches only in traces."""
    g = balls(*[(18.0, 14.0, 2.0)] * 3, (18.0, 14.0, 6.0), sizes=[0.3, 0.3, 0.3, 0.02])
    mask = torch.ones(VIEW.height, VIEW.width, dtype=torch.bool)
    found = select(g, [VIEW], [mask])
    assert found.rows[0] and not found.rows[3] and found.total[3] == 0
    assert vote_by_centres(g, [VIEW], [mask]).rows.all() and select(g, [VIEW], [mask], visible=0).rows[3]
    # in front of them, it is seen
    near = balls(*[(18.0, 14.0, 2.0)] * 3, (18.0, 14.0, 1.0), sizes=[0.3, 0.3, 0.3, 0.02])
    assert select(near, [VIEW], [mask]).rows[3]


def test_an_object_half_hidden_is_judged_by_what_is_seen_of_it():
    """A ring around an occluder lies in the mask, and the object's centre behind it does not."""
    g = balls(*[(18.0, 14.0, 2.0)] * 6, (18.0, 14.0, 5.0), sizes=[0.05] * 6 + [0.2])
    mask = selection_picture(g, torch.arange(7) == 6, VIEW, rasterizer=TORCH) > 0.5
    assert mask.any() and not mask[14, 18]
    assert select(g, [VIEW], [mask]).rows.tolist() == [False] * 6 + [True]
    assert not vote_by_centres(g, [VIEW], [mask]).rows.any()


def test_ties_and_the_unseen_do_not_belong():
    everywhere = torch.ones(VIEW.height, VIEW.width, dtype=torch.bool)
    g = balls((18.0, 14.0, 3.0), (18.0, 14.0, -3.0), (500.0, 14.0, 3.0))
    views, masks = [VIEW, VIEW], [everywhere, ~everywhere]
    for found in (select(g, views, masks), vote_by_centres(g, views, masks)):
        assert found.total[0] == 2 * found.inside[0] > 0 and not found.rows.any()
        assert (found.total[1:] == 0).all()
    assert select(g, views, masks, share=0.49).rows.tolist() == [True, False, False]
    for found in (select(g, [VIEW], [everywhere], share=0), vote_by_centres(g, [VIEW], [everywhere])):
        assert found.rows.tolist() == [True, False, False]


def test_how_many_views_must_agree_by_centres():
    everywhere, g = torch.ones(VIEW.height, VIEW.width, dtype=torch.bool), balls((18.0, 14.0, 3.0))
    masks = [everywhere, everywhere, ~everywhere]
    found = vote_by_centres(g, [VIEW] * 3, masks)
    assert (float(found.inside[0]), float(found.total[0])) == (2, 3) and found.rows.all()
    assert not vote_by_centres(g, [VIEW] * 3, [~everywhere, *masks[1:]]).rows.any()


def test_what_an_attenuation_hides_has_no_vote():
    g, mask = scene(), left_half()
    found = select(g, [VIEW], [mask], attenuation=LevelCut(1))
    assert (found.total[g.level > 1] == 0).all() and not found.rows[g.level > 1].any() and found.rows.any()


def test_focus_draws_the_object_in_full_and_the_base_everywhere():
    g = scene()
    rows = torch.arange(len(g)) < 40
    assert isinstance(Focus(rows), Attenuation)
    assert torch.equal(Focus(rows)(g, VIEW), (rows | (g.level == 1)).double())
    assert torch.equal(Focus(rows, outside_level=0)(g, VIEW), rows.double())
    both = Product((Focus(rows, outside_level=2), LevelCut(2)))
    assert torch.equal(both(g, VIEW), (g.level <= 2).double())
    draw = lambda at: render(g, VIEW, at, rasterizer=TORCH).features  # noqa: E731
    torch.testing.assert_close(draw(Focus(torch.ones_like(rows))), draw(None))
    torch.testing.assert_close(draw(Focus(torch.zeros_like(rows))), draw(LevelCut(1)))


def test_shares_of_a_part_and_of_the_rest_make_one():
    g = scene()
    rows = torch.arange(len(g)) % 2 == 0
    part, rest = (selection_picture(g, r, VIEW, rasterizer=TORCH) for r in (rows, ~rows))
    drawn = render(g, VIEW, rasterizer=TORCH).alpha[..., 0] > 0
    torch.testing.assert_close((part + rest)[drawn], torch.ones(int(drawn.sum()), dtype=torch.float64))
    assert (part[~drawn] == 0).all() and part.min() >= 0 and part.max() <= 1
    empty = g.select(torch.arange(0))
    assert not selection_picture(empty, rows[:0], VIEW, rasterizer=TORCH).any()


def test_extremes_are_finite():
    g = scene(12)
    scales = g.scales.clone()
    scales[:3], scales[3:6] = 1e-8, 1e6
    opacities = g.opacities.clone()
    opacities[6:9] = 0.0
    g = dataclasses.replace(g, scales=scales, opacities=opacities)
    found = select(g, [VIEW], [left_half()])
    assert torch.isfinite(found.inside).all() and torch.isfinite(found.total).all() and not found.rows[6:9].any()
    nothing = select(g.select(torch.arange(0)), [VIEW], [left_half()])
    assert nothing.rows.shape == (0,) and nothing.count == 0


def test_what_covers_the_whole_image_is_seen():
    """Its alpha adds up to many times the image, if it is not cut off at the border."""
    g = balls((18.0, 14.0, 3.0), sizes=50.0, opacity=0.5)
    weights = view_weights(g, VIEW, left_half(), rasterizer=TORCH, visible=0.5)
    assert float(weights[0, 1]) == pytest.approx(0.5 * VIEW.width * VIEW.height, rel=1e-3)


def test_bad_input_is_named():
    g, mask = scene(12), left_half()
    for ask in (lambda c, m: select(g, c, m), lambda c, m: vote_by_centres(g, c, m)):
        with pytest.raises(MaskError, match="0 masks for 0 views"):
            ask([], [])
        with pytest.raises(MaskError, match="1 masks for 2 views"):
            ask([VIEW, VIEW], [mask])
        with pytest.raises(MaskError, match="mask 1 is 36x29 px, and its view 37x29 px"):
            ask([VIEW, VIEW], [mask, mask[:, 1:]])
        with pytest.raises(MaskError, match="the mask is empty"):
            ask([VIEW], [mask & False])
        with pytest.raises(MaskError, match="all of the 2 masks are empty"):
            ask([VIEW, VIEW], [mask & False] * 2)
    for share in (-0.1, 1.0, float("nan")):
        with pytest.raises(ValueError, match=f"share is {share}"):
            select(g, [VIEW], [mask], share=share)
    with pytest.raises(ValueError, match=r"visible is 1\.5"):
        select(g, [VIEW], [mask], visible=1.5)
    with pytest.raises(ValueError, match="of 11 Gaussians, and the scene has 12"):
        Focus(torch.ones(11, dtype=torch.bool))(g, VIEW)
    with pytest.raises(ValueError, match="of 11 Gaussians"):
        selection_picture(g, torch.ones(11, dtype=torch.bool), VIEW, rasterizer=TORCH)
    with pytest.raises(ValueError, match="outside_level is -1"):
        Focus(torch.ones(12, dtype=torch.bool), outside_level=-1)
