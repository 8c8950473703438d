"""The papers' claims: each is measured, judged by its condition, and shown with its figures."""

import io
import sys
from pathlib import Path

import pytest
import torch
from rich.console import Console

sys.path.insert(0, str(Path(__file__).parent))

from fake_lab import SCENE, FakeTools, levels_run

from freqgs_plugin.reports.bench.options import BenchError
from freqgs_plugin.reports.bench.page import check_places
from freqgs_plugin.reports.experiments import claims, claims_goals, claims_levels, claims_measures
from freqgs_plugin.reports.experiments.claims import CLAIMS, RUNS, training_of
from freqgs_plugin.reports.experiments.claims_page import claims_text, finished_of, place_of
from freqgs_plugin.reports.experiments.claims_runner import MEASURED, run_claims
from freqgs_plugin.reports.experiments.options import ClaimsOptions, ExperimentError
from freqgs_plugin.reports.experiments.training import Trial

BY_NAME = {claim.name: claim for claim in CLAIMS}


def run_of(**figures):
    return {"psnr": 25.0, "gaussians": 100, "counts": [50, 30, 20], "prefixes": [30.0, 28.0, 25.0],
            "added": [60.0, 8.0, 4.0], "scales": [0.3, 0.2, 0.1], **figures}  # fmt: skip


@pytest.mark.parametrize(("gain", "holds"), [(0.94, False), (0.96, True), (-0.3, False)])
def test_the_gain_over_the_base_method_is_that_of_the_papers_settings(gain, holds):
    result = {"plain": run_of(), "paper": run_of(psnr=25 + gain), "lapsplat": run_of(psnr=29.0)}
    verdict = BY_NAME["A-a"].judge("room", [result])
    assert verdict.holds == holds
    assert verdict.found == f"{gain:+.2f} dB with the paper's settings, +4.00 dB with ours"


@pytest.mark.parametrize(
    ("count", "time", "holds"), [(64, 7.0, True), (66, 7.0, False), (64, 7.2, False), (10, 20.0, False)]
)
def test_fewer_and_faster_are_asked_together(count, time, holds):
    runs = {"plain": run_of(), "paper": run_of(gaussians=count), "lapsplat": run_of(gaussians=20)}
    times = {"plain": {"median_ms": 10.0}, "paper": {"median_ms": time}, "lapsplat": {"median_ms": 5.0}}
    verdict = BY_NAME["A-b"].judge("room", [{"runs": runs, "times": times}])
    assert verdict.holds == holds and "0.20 of the Gaussians, 2.00 x as fast with ours" in verdict.found


def test_what_is_left_out_has_to_matter():
    paper = run_of()
    without = {"paper": paper, "no DFT": run_of(added=[60.0, 3.0, 2.0])}
    assert BY_NAME["A-c"].judge("room", [without]).holds
    assert not BY_NAME["A-c"].judge("room", [{**without, "no DFT": run_of(added=[60.0, 5.0, 2.0])}]).holds
    lower = {"paper": paper, "no lower levels": run_of(prefixes=[28.0, 26.0, 25.0])}
    verdict = BY_NAME["A-d"].judge("room", [lower])
    assert verdict.holds and verdict.found == "prefix 1: -2.00 dB, prefix 2: -2.00 dB"
    assert not BY_NAME["A-d"].judge("room", [{**lower, "no lower levels": run_of(prefixes=[28.0, 27.0, 25.0])}]).holds
    assert BY_NAME["A-e"].judge("room", [{"paper": paper, "unsigned": run_of(gaussians=114)}]).holds
    assert not BY_NAME["A-e"].judge("room", [{"paper": paper, "unsigned": run_of(gaussians=112)}]).holds
    sizes = {"paper": run_of(scales=[0.3, 0.1, 0.2]), "lapsplat": paper}
    assert (
        not BY_NAME["A-f"].judge("room", [sizes]).holds
        and BY_NAME["A-f"].judge("room", [{**sizes, "paper": paper}]).holds
    )


def test_a_claim_on_levels_is_not_judged_where_photographs_are_too_small_for_them():
    for levels, judged in ((1, ()), (2, ("A-c", "A-f")), (3, ("A-c", "A-d", "A-f"))):
        run = run_of(**{key: run_of()[key][:levels] for key in ("counts", "prefixes", "added", "scales")})
        result = dict.fromkeys(("paper", "lapsplat", "no DFT", "no lower levels"), run)
        verdicts = {name: BY_NAME[name].judge("room", [result]) for name in ("A-c", "A-d", "A-f")}
        assert {name for name, verdict in verdicts.items() if verdict.holds is not None} == set(judged)
        found = {name: [] for name in MEASURED} | {"A-f": [result]}
        (row,) = [line for line in claims_text("room", found, "claims-A", 1).splitlines() if line.startswith("| A-f")]
        reason = "it needs 2 levels, and these photographs are large enough for 1"
        assert row.endswith(f"| {reason} | not measurable here |") == (levels == 1)
        alone = {"gaussians": 1, "small": 1.0, "reduced": 1.0}
        of_goals = {"runs": {"plain": run_of(), "lapsplat": run, "small base": run}, "alone": [alone] * 2}
        assert len(claims_goals.goals("room", [of_goals])) == (8 if levels == 3 else 2)


def test_figures_of_levels_are_of_prefixes_and_changes():
    run = levels_run()
    found = claims_measures.figures(run)
    assert found["counts"] == [20, 20, 20] and found["gaussians"] == 60 == found["drawn"]
    assert len(found["prefixes"]) == len(found["added"]) == len(found["scales"]) == 3
    # the last prefix is the picture itself
    assert found["prefixes"][2] == pytest.approx(found["psnr"], abs=1e-4)
    assert all(value > 0 for value in found["added"])


def test_all_claims_are_measured_once_and_shown(tmp_path, monkeypatch):
    monkeypatch.setattr(claims_measures, "FOVEATED_SIZE", (48, 32))
    docs = tmp_path / "docs" / "claims.md"
    docs.parent.mkdir()
    names = ("claims-A", "claims-B", "goals", "runs", "levels")
    places = (f"<!-- {name} room -->\n<!-- end of {name} room -->\n" for name in names)
    docs.write_text("# Claims\n\n<!-- claims-A hall -->\nkept\n" + "".join(places))
    options = ClaimsOptions(
        output_dir=tmp_path / "out", demo=False, scenes=(Path("room"),), frames=4, steps=30, docs=docs
    )
    tools = FakeTools(tmp_path / "runs")
    console = Console(width=300, record=True, file=io.StringIO())
    with pytest.raises(ExperimentError, match="nothing finished"):
        run_claims(ClaimsOptions(**{**vars(options), "page_only": True}), [SCENE], tools.tools(), console)
    found = run_claims(options, [SCENE], tools.tools(), console)
    assert {name for name, results in found["room"][1].items() if results} == {*BY_NAME, "goals", "runs", "levels"}
    # 9 of the table of runs, 2 of one size, s_max 1, plain's coarse sibling, s_max 5 and that without w_s and without
    # L_reg, 3 of levels
    assert len(tools.trained) == 9 + 2 + 2 + 3 + 3
    assert len(tools.trained) == len({str(training) for training in tools.trained})
    page = docs.read_text(encoding="utf-8")
    whole = (tmp_path / "out" / "claims.md").read_text(encoding="utf-8")
    tables = [part for part in whole.split("## room")[1].strip().split("\n\n") if part.startswith("|")]
    assert len(tables) == 5 and all(table in page for table in tables) and "<!-- claims-A hall -->\nkept" in page
    for claim in CLAIMS:
        (row,) = (line for line in page.splitlines() if line.startswith(f"| {claim.name} "))
        assert row.endswith(("| holds |", "| does not hold |")) and claim.paper in row
    assert all(f"| {name} |" in page for name in (*RUNS, *claims_levels.CHOICES))
    assert "* auto: chosen by {'method': 'lapsplat', 'num_levels': 'auto'}" in page
    assert "| lapsplat, prefix 2: at most 1 dB under a plain model of its size |" in page
    again = FakeTools(tmp_path / "runs")
    run_claims(options, [SCENE], again.tools(), console)
    assert again.trained == []


def test_a_part_is_measured_alone_and_the_rest_is_said_to_be_missing(tmp_path):
    tools, console = FakeTools(tmp_path / "runs"), Console(width=300, record=True, file=io.StringIO())
    settings = {"output_dir": tmp_path / "out", "demo": False, "scenes": (Path("room"),), "frames": 4, "steps": 30}
    run_claims(ClaimsOptions(**settings, only=("goals,A-e",)), [SCENE], tools.tools(), console)
    # plain, lapsplat with any and with a small base, two of one size; the paper's, and it with unsigned colours
    assert len(tools.trained) == 5 + 2
    page = (tmp_path / "out" / "claims.md").read_text(encoding="utf-8")
    missing = [line for line in page.splitlines() if line.endswith("| not measured |")]
    # A-a, A-f and A-g need no other runs, but nobody asked for what they measure
    assert {line.split(" | ")[0][2:] for line in missing} >= {"A-b", "A-c", "A-d", "A-g"}
    assert "B-a" not in page, "no table of claims none of which was measured"
    settings["page_only"] = True
    with pytest.raises(ExperimentError, match="holds nothing finished of levels of these scenes"):
        run_claims(ClaimsOptions(**settings, only=("levels",)), [SCENE], tools.tools(), console)
    run_claims(ClaimsOptions(**settings, only=("levels", "A-e")), [SCENE], tools.tools(), console)
    assert "Nothing finished of levels: room; leave out --page-only to measure it." in console.export_text()
    with pytest.raises(ExperimentError, match="--only A-z: choose among A-a, A-b"):
        run_claims(ClaimsOptions(**settings, only=("A-z",)), [SCENE], tools.tools(), console)


def test_a_page_without_a_scenes_place_is_refused_before_anything_is_trained(tmp_path):
    tools, console = FakeTools(tmp_path / "runs"), Console(file=io.StringIO())
    docs = tmp_path / "claims.md"
    options = ClaimsOptions(output_dir=tmp_path / "out", demo=False, scenes=(Path("room"),), docs=docs)
    for text, missing in (
        ("# Claims", "claims-A room"),
        ("<!-- claims-A room --><!-- end of claims-A room -->", "claims-B room"),
    ):
        docs.write_text(text)
        with pytest.raises(BenchError, match=f"<!-- {missing} -->"):
            run_claims(options, [SCENE], tools.tools(), console)
    assert tools.trained == [] and not (tmp_path / "out").exists()


def test_the_page_of_the_documentation_has_every_place():
    page = Path(__file__).parents[2] / "docs" / "claims.md"
    names = [f"{place_of(name)} {scene}" for scene in ("banana", "brighton_beach", "demo") for name in MEASURED]
    check_places(page.read_text(encoding="utf-8"), names, page)


def test_a_row_of_fewer_seeds_says_so():
    two = {"plain": run_of(), "clodsplat-paper": run_of(), "clodsplat": run_of()}
    found = {name: [] for name in MEASURED} | {"B-a": [two], "B-c": []}
    (row,) = [line for line in claims_text("room", found, "claims-B", 2).splitlines() if line.startswith("| B-a")]
    assert "(1 of 2 seeds) | does not hold |" in row
    for count, seeds in ((2, 2), (1, 1)):
        assert "seeds)" not in claims_text("room", {**found, "B-a": [two] * count}, "claims-B", seeds)
    assert finished_of(0, 2) == "" and finished_of(1, 2) == "1 of 2 seeds"


def test_the_papers_settings_are_those_of_the_registered_method():
    assert claims.VARIANTS["paper"] == ("lapsplat-paper", {})
    assert training_of(Trial(SCENE, 30, 42), "clodsplat-paper").method == "clodsplat-paper"


def goals_with(gain=0.6, count=50, base=0.1, above=(-0.9, -0.9)):
    plain, ours = run_of(gaussians=100), run_of(psnr=25 + gain, gaussians=count, prefixes=[30.0, 28.0, 25.0])
    ours["counts"] = [base * count, 0, count - base * count]
    alone = [{"gaussians": 10, "small": p - a, "reduced": 0.0} for p, a in zip((30.0, 28.0), above, strict=True)]
    runs = {"plain": plain, "lapsplat": ours, "small base": ours}
    found = claims_goals.goals("room", [{"runs": runs, "alone": alone}])
    first, second = (found[:4], found[4:])
    assert [goal.reached for goal in first] == [goal.reached for goal in second]
    return [goal.reached for goal in first]


@pytest.mark.parametrize(
    ("change", "missed"),
    [
        ({}, None),
        ({"gain": 0.4}, 0),
        ({"count": 61}, 0),
        ({"base": 0.16}, 1),
        ({"above": (-1.1, -0.9)}, 2),
        ({"above": (-0.9, -1.1)}, 3),
    ],
)
def test_each_goal_can_be_missed(change, missed):
    assert [i for i, reached in enumerate(goals_with(**change)) if not reached] == ([] if missed is None else [missed])


def test_a_model_of_one_size_is_judged_at_that_size():
    run = levels_run()
    found = claims_goals.at_own_size(run, 1)
    view = run.cameras("test")[0]
    camera = claims_goals._halved(view.camera, 1)
    assert (camera.width, camera.height) == (view.camera.width // 2, view.camera.height // 2)
    assert torch.equal(camera.K[:2], view.camera.K[:2] / 2) and camera.K[2, 2] == 1
    # whole size: both figures are those of the full picture
    whole = claims_goals.at_own_size(run, 0)
    assert whole["small"] == pytest.approx(whole["reduced"]) and found["small"] != pytest.approx(whole["small"])
    training = claims_goals.alone(Trial(SCENE, 30, 42), 1)
    assert training.options["num_levels"] == 3 and training.options["coarse_growth_factor"] == 1.0


def test_levels_are_shown_with_their_bytes_and_what_the_run_said():
    runs = {
        name: {**run_of(psnr=25.0 + i, gaussians=1000 * i, ssim=0.5), "bytes": 236_000 * i, "said": []}
        for i, name in enumerate(claims_levels.CHOICES, 1)
    }
    runs["auto"]["said"] = ["2 levels."]
    times = {name: {"median_ms": 10.0 * i} for i, name in enumerate(runs, 1)}
    page = claims_levels.text("room", [{"runs": runs, "times": times}])
    assert "| auto | 27.00 | 0.500 | 2,000 | 0.47 | 20.0 | 50 / 30 / 20 |" in page
    assert page.endswith("* auto: 2 levels.")
    # 14 numbers of every Gaussian, 3 of each of 3 further harmonics; all float32
    assert claims_levels.chosen(levels_run(said=["why"])) == {"bytes": 60 * 4 * (14 + 9), "said": ["why"]}
