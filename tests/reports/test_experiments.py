"""What experiments measure: selection, changes, spread, goals, sections on random Gaussians. Nothing is trained."""

import itertools
import json
import math
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parent))

from fake_lab import SCENE, decaying_run, fake_lab
from fake_run import fake_run, fake_views

from freqgs_plugin.functional.attenuation import DistanceDecay
from freqgs_plugin.functional.budget import decay_scale, in_view
from freqgs_plugin.functional.similarity import Similarity
from freqgs_plugin.reports.drawing import draw
from freqgs_plugin.reports.experiments import ablation, budget, curve, dolly, jumps, pops, sigma
from freqgs_plugin.reports.experiments.goals import Goal, goal_markdown, goal_table, summary
from freqgs_plugin.reports.experiments.measures import Changes, at_scale, changes, neighbours, quality
from freqgs_plugin.reports.experiments.options import SECTIONS, ClodOptions, ExperimentError, command_line
from freqgs_plugin.reports.experiments.seeds import mean, shown, spread
from freqgs_plugin.reports.experiments.selection import MostOpaque, SharedDecay
from freqgs_plugin.reports.experiments.training import DEFAULT_SCALE, Trial, fingerprint
from freqgs_plugin.reports.tables import finite_json, psnr


@pytest.fixture
def view():
    return fake_views(1)[0]


def as_json(value):
    return json.loads(json.dumps(finite_json(value)))


# -- which Gaussians are kept -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("within_view", [True, False])
@pytest.mark.parametrize("count", [1, 7, 60, 100])
def test_the_most_opaque_are_kept_as_they_are(view, count, within_view):
    gaussians = fake_run(n=60).gaussians
    weight = MostOpaque(count, within_view)(gaussians, view.camera)
    among = in_view(gaussians, view.camera) if within_view else torch.ones(60, dtype=torch.bool)
    kept = weight > 0
    assert int(kept.sum()) == min(count, int(among.sum())) and set(weight.tolist()) <= {0.0, 1.0}
    assert not bool((kept & ~among).any())
    left_out = among & ~kept
    if bool(left_out.any()):
        assert float(gaussians.opacities[kept].min()) >= float(gaussians.opacities[left_out].max())


def test_of_equally_opaque_ones_the_first_are_kept(view):
    gaussians = fake_run(n=60).gaussians
    gaussians = replace(gaussians, opacities=torch.full((60,), 0.5))
    weight = MostOpaque(9, within_view=False)(gaussians, view.camera)
    assert weight.nonzero().flatten().tolist() == list(range(9))


@pytest.mark.parametrize("count", [1, 10, 37])
@pytest.mark.parametrize("decay", [0.1, 5.0, 100.0])
def test_a_shared_decay_meets_the_count_and_chooses_by_the_formula(view, count, decay):
    gaussians = fake_run(n=80).gaussians
    chosen = SharedDecay(count, decay, 2.5, fade=False)(gaussians, view.camera)
    faded = SharedDecay(count, decay, 2.5)(gaussians, view.camera)
    assert int((chosen > 0).sum()) == count and set(chosen.tolist()) <= {0.0, 1.0}
    assert torch.equal(faded > 0, chosen > 0) and bool((faded <= chosen).all())
    shared = replace(gaussians, decay=torch.full((80,), decay))
    scale = decay_scale(shared, view.camera, count, "scene", 2.5, least=1e-6).scale
    formula = DistanceDecay(scale, scene_distance=2.5, soft=False)(shared, view.camera)
    torch.testing.assert_close(faded, formula * in_view(gaussians, view.camera))


def test_a_long_shared_decay_chooses_by_opacity(view):
    gaussians = fake_run(n=80).gaussians
    chosen = SharedDecay(20, 1e5, 2.5, fade=False)(gaussians, view.camera)
    assert torch.equal(chosen, MostOpaque(20)(gaussians, view.camera))


def test_a_short_shared_decay_prefers_what_is_near(view):
    gaussians = replace(fake_run(n=80).gaussians, opacities=torch.full((80,), 0.5))
    distance = torch.linalg.norm(gaussians.means - view.camera.centre, dim=1)
    kept = SharedDecay(10, 0.5, 2.5)(gaussians, view.camera) > 0
    seen = in_view(gaussians, view.camera)
    assert float(distance[kept].max()) <= float(distance[seen & ~kept].min())


# -- pictures ---------------------------------------------------------------------------------------------------------


def test_quality_is_the_mean_over_views_of_clamped_pictures():
    run = decaying_run()
    views = run.cameras("test")
    found = quality(run, views)
    each = [psnr(draw(run, v.camera).features.clamp(0, 1), v.image) for v in views]
    assert found.psnr == pytest.approx(sum(each) / 2) and found.drawn == 60
    assert 0 < found.ssim < 1
    fewer = quality(run, views, lambda number: MostOpaque(10 * (number + 1), within_view=False))
    assert fewer.drawn == 15, "each view has its own attenuation"


def test_a_run_whose_decays_do_not_act_is_refused():
    with pytest.raises(ExperimentError, match="train longer"):
        at_scale(decaying_run(None), 1.0)
    assert at_scale(decaying_run(), 3.0) == DistanceDecay(3.0, "scene", 2.5, soft=True), "what the viewer draws"


def test_changes_between_frames():
    steps = (0.0, 0.1, 0.1, 0.4, 0.5)
    frames = [torch.full((4, 5, 3), value) for value in steps]
    found = changes(neighbours(iter(frames)))
    assert found.each == pytest.approx([25.5, 0, 76.5, 25.5], abs=1e-4)
    assert found.largest == pytest.approx(76.5, abs=1e-4) and found.worst_pixel == pytest.approx(76.5, abs=1e-4)
    assert found.median == pytest.approx(25.5, abs=1e-4) and found.mean == pytest.approx(31.875, abs=1e-4)
    assert found.largest_by_median == pytest.approx(3, abs=1e-5)


def test_what_grows_slowly_is_not_sudden():
    def of(values):
        return Changes([float(v) for v in values], 0.0)

    assert of(range(100)).sudden == pytest.approx(2.5), "at the ends there are fewer around"
    assert of([1] * 50).sudden == 0
    assert of([1] * 20 + [8] + [1] * 20).sudden == 7
    assert of([3]).sudden == 0


def test_changes_of_what_is_not_shown_do_not_count():
    bright, brighter = torch.full((4, 5, 3), 1.5), torch.full((4, 5, 3), 9.0)
    assert changes([(bright, brighter)]).largest == 0
    one = torch.zeros(4, 5, 3)
    one[0, 0, 0] = 1.0
    found = changes([(torch.zeros(4, 5, 3), one)])
    assert found.worst_pixel == 255 and found.largest == pytest.approx(255 / 60)
    assert changes([(one, one), (one, one), (one, 0 * one)]).largest_by_median == math.inf
    with pytest.raises(ValueError, match="no frames"):
        changes([])


def test_a_moved_camera_sees_the_moved_scene(view):
    turn = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
    frame = Similarity(turn, torch.tensor([0.3, -0.2, 0.9], dtype=torch.float64), 2.5)
    moved = dolly.in_frame(view.camera, frame, torch.device("cpu"))
    points = torch.randn(20, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def seen(camera, x):
        return x @ camera.viewmat[:3, :3].double().T + camera.viewmat[:3, 3].double()

    torch.testing.assert_close(seen(moved, frame.points(points)), 2.5 * seen(view.camera, points), rtol=1e-5, atol=1e-5)
    assert moved.viewmat.dtype == view.camera.viewmat.dtype


def test_a_dolly_is_made_along_the_line_of_sight(view):
    run = decaying_run()
    cameras = dolly.made_from(run, view.camera, 9)
    depth = dolly.draw_depth(run, view.camera)
    inner = depth[7:23, 10:30]
    target = float(inner[inner > 0].median())
    forward = view.camera.viewmat[2, :3]
    looked_at = view.camera.centre + target * forward
    distances = [float(torch.linalg.norm(camera.centre - looked_at)) for camera in cameras]
    assert distances[0] == pytest.approx(0.3 * target, rel=1e-4) and distances[-1] == pytest.approx(
        3.3 * target, rel=1e-4
    )
    ratios = [b / a for a, b in itertools.pairwise(distances)]
    assert ratios == pytest.approx([11 ** (1 / 8)] * 8, rel=1e-4)
    for camera in cameras:
        off_axis = torch.linalg.cross(camera.centre - looked_at, forward)
        assert float(torch.linalg.norm(off_axis)) < 1e-5
    away = dolly.backwards(view.camera, 100.0)
    empty = decaying_run()
    empty.gaussians = replace(empty.gaussians, opacities=torch.zeros(60))
    with pytest.raises(ValueError, match="no Gaussian to move away from"):
        dolly.made_from(empty, away, 3)


# -- seeds and goals --------------------------------------------------------------------------------------------------


def test_spread_over_seeds():
    rows = [{"x": 1.0}, {"x": 2.0}, {"x": 4.5}]
    found = spread(rows, lambda row: row["x"])
    assert found is not None and found.mean == 2.5 and found.half_range == 1.75
    assert shown(rows, lambda row: row["x"], ".1f") == "2.5 ± 1.8"
    assert shown(rows, lambda row: row["x"], "+.1f") == "+2.5 ± 1.8", "half a range has no sign"
    assert shown(rows[:1], lambda row: row["x"], ".1f") == "1.0"
    assert shown([{"x": None}, {"x": 1.0}], lambda row: row["x"]) == "-", "an infinite one has no mean"
    assert math.isnan(mean([{"x": None}], lambda row: row["x"]))


def test_goals_that_are_not_reached_stand_out():
    goals = [Goal("a", "this", "1 dB", True), Goal("b", "that", "2 dB", False)]
    text = goal_markdown(goals)
    assert "| reached |" in text and "| **not reached** |" in text and "2 dB" in text
    assert summary(goals) == "1 of 2 goals are reached."
    assert goal_table(goals).row_count == 2


@pytest.mark.parametrize(
    "largest, against, bound, reached",
    [
        (3.0, 1.0, 3.0, True),
        (3.1, 1.0, 3.0, False),
        (0.5, 5.0, 0.1, True),
        (0.0, 0.0, 3.0, True),
        (0.1, 0.0, 3.0, False),
    ],
)
def test_goals_on_changes(largest, against, bound, reached):
    assert pops.change_goal("room", "text", largest, against, bound).reached is reached


def budget_result(margins, ours=27.0, plain=27.0, counts=(70, 100)):
    """A result whose margins over the best of the others are `margins`, one per share."""
    rows = []
    for share, margin in zip(budget.SHARES, margins, strict=True):
        row = {"share": share, "count": 100 * share, "scale": 2.0}
        row |= {name: {"psnr": 20.0 + margin} for name in budget.OURS}
        row |= {name: {"psnr": 20.0 - i} for i, name in enumerate((*budget.OTHERS, *budget.BESIDES))}
        rows.append(row)
    full = {
        name: {"gaussians": n, "psnr": p, "ssim": 0.9}
        for name, n, p in (("clod", counts[0], ours), ("plain", counts[1], plain))
    }
    return {"shares": rows, "full": full}


def verdicts(*results):
    return [goal.reached for goal in budget.goals("room", list(results))]


def test_goals_at_equal_counts():
    good = [0, 0.1, 0.5, 0.8, 1.0, 1.0, 1.0]
    assert verdicts(budget_result(good)) == [True] * 5
    assert verdicts(budget_result([*good[:4], 0.99, 1, 1]))[0] is False
    assert verdicts(budget_result([-0.01, *good[1:]]))[1] is False
    assert verdicts(budget_result(good, ours=26.95))[4] is True
    assert verdicts(budget_result(good, ours=26.85))[4] is False
    assert verdicts(budget_result(good, counts=(76, 100)))[4] is False
    # judged by means over seeds
    assert verdicts(budget_result([*good[:4], 1.3, 1, 1]), budget_result([*good[:4], 0.8, 1, 1]))[0] is True
    (worst,) = [
        goal for goal in budget.goals("room", [budget_result([*good[:6], -0.5])]) if "never below" in goal.text
    ][:1]
    assert "-0.50 dB, at 10 %" in worst.figures


# -- sections ---------------------------------------------------------------------------------------------------------


def test_equal_counts_are_equal_and_full_detail_is_full():
    clod, plain = decaying_run(), decaying_run(None, n=50)
    found = as_json(budget.compare(clod, plain, 5.0))
    for row in found["shares"]:
        for name in (*budget.OURS, *budget.OTHERS, *budget.BESIDES):
            assert row[name]["drawn"] == pytest.approx(row["count"]), (row["share"], name)
    assert found["full"]["plain"]["drawn"] == 50 and found["full"]["clod"]["gaussians"] == 60
    scales = [row["scale"] for row in found["shares"]]
    assert scales == sorted(scales)
    assert found["shares"][0]["opacity"]["psnr"] == pytest.approx(found["full"]["plain"]["psnr"], abs=1e-3)
    assert all(row["shared"]["decay"] in budget.DECAYS for row in found["shares"])


def test_jumps_of_a_sweep_a_dolly_and_a_switch(view):
    run, fine, coarse = decaying_run(1.0), decaying_run(None, n=60), decaying_run(None, n=20)
    cameras = dolly.made_from(run, view.camera, 7)
    seen = []
    found = jumps.jumps(run, [fine, coarse], view, cameras, 6, seen.append)
    paths = found["paths"]
    assert set(paths) == set(jumps.PATHS) and seen == [1, 2, 3, 4, 5, 6]
    switch = paths["sweep"][jumps.SWITCH]
    assert [i for i, change in enumerate(switch["each"]) if change > 0] == [2], "one jump, in the middle"
    assert switch["median"] == 0 and switch["largest_by_median"] == math.inf
    assert as_json(switch)["largest_by_median"] is None
    assert [i for i, c in enumerate(paths["fading"][jumps.SWITCH]["each"]) if c > 0] == [2]
    assert all(c > 0 for c in paths["dolly"][jumps.CAMERA]["each"]), "the camera moves"
    for path in jumps.PATHS:
        for name in jumps.variants(run):
            assert len(paths[path][name]["each"]) == 6, (path, name)
    assert len(found["psnr"][jumps.DEFAULT]) == 7 and found["scales"][0] == 1 and found["scales"][-1] == DEFAULT_SCALE
    expected = psnr(draw(run, view.camera, at_scale(run, 1.0)).features.clamp(0, 1), view.image)
    assert found["psnr"][jumps.DEFAULT][0] == pytest.approx(expected)


def test_fading_alone_has_no_motion(view):
    run = decaying_run(1e6)
    cameras = dolly.made_from(run, view.camera, 4)
    pairs = jumps.fading_alone(run, cameras, at_scale(run, 1.0))
    assert changes(pairs).largest == pytest.approx(0, abs=1e-3), "nothing fades at all"
    moving = changes(neighbours(draw(run, camera, at_scale(run, 1.0)).features for camera in cameras))
    assert moving.largest > 1


def test_shares_and_quantiles_of_decays():
    run = decaying_run()
    decays = torch.linspace(0.1, 30, 60)
    decays[:6] = -1.0
    run.gaussians = replace(run.gaussians, decay=decays)
    found = sigma.distribution(run)
    assert found["dead"] == pytest.approx(0.1)
    assert sum(found["decay"]["shares"]) == pytest.approx(1) and sum(found["opacity"]["shares"]) == pytest.approx(1)
    assert found["decay"]["shares"][-1] > 0.4, "what is above the last bin is in it"
    assert found["decay"]["quantiles"] == sorted(found["decay"]["quantiles"])


def test_every_section_makes_tables_and_pictures_of_two_seeds(tmp_path):
    lab, _ = fake_lab(tmp_path)
    options = ClodOptions(tmp_path, s_max=(1.0, DEFAULT_SCALE), frames=4)
    for part in (curve.PART, budget.PART, pops.PART, ablation.PART, sigma.PART):
        results = [part.measure(lab, Trial(SCENE, 30, seed), options) for seed in (42, 43)]
        for table in part.tables("room", results):
            assert table.rows and "nan" not in table.markdown(), table.markdown()
        for figure in part.figures("room", results).values():
            assert figure.axes
        goals = part.goals("room", results)
        assert all(isinstance(goal, Goal) and "nan" not in goal.figures for goal in goals)
        assert bool(goals) == (part.name in ("budget", "pops", "ablation"))


def test_a_gradient_without_effect_does_not_act():
    def result(counts):
        cell = {"gaussians": 100, "full": {"psnr": 20.0, "drawn": 100.0}}
        return {
            ablation.name_of(weigh, gradient): {**cell, "reduced": {"psnr": 18.0, "drawn": count}}
            for weigh in (True, False)
            for gradient, count in zip(ablation.GRADIENTS, counts, strict=True)
        }

    goals = ablation.goals("room", [result((100.0, 100.0, 90.0, 96.0))])
    assert [goal.reached for goal in goals] == [False, True, False]
    assert goals[1].figures == "-10.0 %"


# -- options ----------------------------------------------------------------------------------------------------------


def test_sections_are_named_with_spaces_or_commas():
    assert ClodOptions(only=("sigma,curve", "pops")).sections == ("curve", "pops", "sigma")
    assert ClodOptions().sections == SECTIONS
    with pytest.raises(ExperimentError, match="--only curv: choose among curve, budget, pops, ablation, sigma"):
        ClodOptions(only=("curv",))


@pytest.mark.parametrize(
    "options, message",
    [
        ({"demo": False}, "name folders with --scenes"),
        ({"seeds": 0}, "at least 1"),
        ({"frames": 3}, "at least 4"),
        ({"views": 1}, "--views must be at least 2 .* not 1 and 320 240"),
        ({"size": (16, 15)}, "--size at least 16, not 36 and 16 15"),
        ({"s_max": (0.5,)}, "1 or more"),
        ({"s_max": ()}, "at least one number"),
        ({"scenes": (Path("a/room"), Path("b/room"))}, "told apart by the names"),
        ({"scenes": (Path("demo"),)}, "told apart by the names"),
    ],
)
def test_options_that_make_no_sense_are_refused(options, message):
    with pytest.raises(ExperimentError, match=message):
        ClodOptions(**options)


def test_the_command_line_holds_what_differs_and_no_folders(tmp_path):
    more = {"only": ("curve",), "steps": 300, "s_max": (1.0, 5.0), "docs": tmp_path}
    options = ClodOptions(tmp_path, (tmp_path / "room",), False, **more)
    assert command_line(options, "clod") == "freqgs experiment clod --scenes room --no-demo --steps 300 --s-max 1 5"
    assert command_line(ClodOptions(), "clod") == "freqgs experiment clod"


def test_fingerprints_follow_the_files_and_not_the_place(tmp_path):
    for place in ("a", "b"):
        (tmp_path / place / "room" / "images").mkdir(parents=True)
        (tmp_path / place / "room" / "images" / "x.png").write_text("12345")
    one, two = fingerprint(tmp_path / "a" / "room"), fingerprint(tmp_path / "b" / "room")
    assert one == two and one.startswith("room ")
    (tmp_path / "a" / "room" / "images_2").mkdir()
    (tmp_path / "a" / "room" / "images_2" / "x.png").write_text("1")
    assert fingerprint(tmp_path / "a" / "room") == one, "nerfstudio makes these"
    ours = tmp_path / "a" / "room" / "clod-out"
    ours.mkdir()
    (ours / "clod.json").write_text("written by an experiment")
    assert fingerprint(tmp_path / "a" / "room", ours) == one != fingerprint(tmp_path / "a" / "room")
    (ours / "clod.json").unlink()
    (tmp_path / "a" / "room" / "images" / "x.png").write_text("123456")
    assert fingerprint(tmp_path / "a" / "room") != one
