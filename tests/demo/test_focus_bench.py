"""`freqgs bench focus` on the demo scene, with Gaussians laid on what the views show instead of trained ones."""

import json
from types import SimpleNamespace

import pytest
import torch

from freqgs_plugin import cli
from freqgs_plugin.demo import benches
from freqgs_plugin.demo.dataset import MANIFEST
from freqgs_plugin.demo.raytrace import depth_map, object_ids, render_truth
from freqgs_plugin.demo.scene import build_world, orbit
from freqgs_plugin.rendering.base import get_rasterizer
from freqgs_plugin.reports.bench import trained
from freqgs_plugin.reports.bench.focus_cases import box_of, clearest_view, outcomes, point_in, rendered_iou
from freqgs_plugin.reports.bench.options import BenchError
from freqgs_plugin.types import Gaussians

WIDTH, HEIGHT, VIEWS = 96, 72, 9


def discs(world, camera):
    """A small ball on each pixel."""
    z = torch.from_numpy(depth_map(world, camera)).flatten()
    y, x = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    rays = torch.stack([x.flatten(), y.flatten(), torch.ones_like(z)], 1) @ torch.linalg.inv(camera.K).T
    return (rays * z[:, None] - camera.viewmat[:3, 3]) @ camera.viewmat[:3, :3], 0.5 * z / camera.K[0, 0]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Views 0, 3 and 6 are held out, and everything is made of the others."""
    folder = tmp_path_factory.mktemp("scene")
    options = {"num_views": VIEWS, "width": WIDTH, "height": HEIGHT, "num_points": 9, "samples": 1, "seed": 0}
    (folder / MANIFEST).write_text(json.dumps({"written_by": "freqgs demo", **options}))
    world, cameras = build_world(0), orbit(VIEWS, WIDTH, HEIGHT, 0)
    views = [
        SimpleNamespace(name=f"view_{i:03d}.png", camera=c, image=torch.from_numpy(render_truth(world, c, 1)))
        for i, c in enumerate(cameras)
    ]
    train = [i for i in range(VIEWS) if i % 3]
    parts = [discs(world, cameras[i]) for i in train]
    means, sizes = torch.cat([m for m, _ in parts]).float(), torch.cat([s for _, s in parts]).float()
    n = len(means)
    gaussians = Gaussians(
        means, torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1), sizes[:, None].repeat(1, 3), torch.full((n,), 0.9),
        torch.cat([(views[i].image.reshape(-1, 3) - 0.5) / 0.282 for i in train]).float(), torch.zeros(n, 0, 3),
        torch.ones(n, dtype=torch.long),
    )  # fmt: skip
    chosen = {"train": [views[i] for i in train], "test": [v for i, v in enumerate(views) if i % 3 == 0]}
    return SimpleNamespace(
        gaussians=gaussians, rasterizer=get_rasterizer("numba", "cpu"), antialiased=True,
        cameras=lambda split: chosen[split],
        config=SimpleNamespace(pipeline=SimpleNamespace(datamanager=SimpleNamespace(data=folder))),
        truth=torch.cat([torch.from_numpy(object_ids(world, cameras[i])).flatten() for i in train]),
    )  # fmt: skip


def test_a_vote_finds_the_object(run):
    subject = benches.subject_of(run)
    assert (len(subject.train), len(subject.test)) == (6, 3)
    assert [name for name, _ in subject.objects][:3] == ["astronaut box", "moon", "red ball"]
    number = dict(subject.objects)["astronaut box"]
    true = rendered_iou(subject, run.truth == number, number)
    found = outcomes(subject, number, 3)
    # balls on its border are seen on both sides of it
    assert true is not None and true > 0.8 and found["weight"].iou == pytest.approx(true, abs=0.1)
    assert all(outcome.seconds > 0 for outcome in found.values())
    assert found["box"].mask_iou > 0.7 and found["weight"].mask_iou is None


def test_focus_from_the_command_line(run, tmp_path, monkeypatch):
    monkeypatch.setattr(trained, "load", lambda path: run)
    page = tmp_path / "page.md"
    page.write_text("".join(f"<!-- {t} -->\n<!-- end of {t} -->\n" for t in ("focus", "focus-times")))
    arguments = ["--quick", "--output-dir", str(tmp_path), "--docs", str(page)]
    cli.main(["bench", "focus", "--load-config", "x.yml", *arguments])
    report = json.loads((tmp_path / "focus.json").read_text())
    assert report["command"] == "freqgs bench focus --load-config RUN/config.yml --quick"
    rows = report["tables"]["focus"]["rows"]
    assert [row["object"] for row in rows] == ["astronaut box", "moon"]
    assert 0 <= rows[0]["centres"]["iou"] <= rows[0]["weight"]["iou"] + 0.1
    assert "| astronaut box |" in page.read_text() and "`vote`, 6 masks" in page.read_text()


def test_other_runs_are_refused(run, tmp_path, monkeypatch):
    elsewhere = SimpleNamespace(pipeline=SimpleNamespace(datamanager=SimpleNamespace(data=tmp_path)))
    with pytest.raises(BenchError, match=f"has no {MANIFEST}"):
        benches.subject_of(SimpleNamespace(config=elsewhere))
    train = run.cameras("train")
    with monkeypatch.context() as patch:
        patch.setattr(run, "cameras", lambda split: train if split == "train" else [])
        with pytest.raises(BenchError, match="6 training and 0 held-out views"):
            benches.subject_of(run)
        small = SimpleNamespace(name="view_001.png", camera=orbit(2, 48, 36)[0], image=None)
        patch.setattr(run, "cameras", lambda split: [small])
        with pytest.raises(BenchError, match=r"used at \(48, 36\) px, and was made at \(96, 72\)"):
            benches.subject_of(run)


def test_what_a_hand_would_mark():
    mask = torch.zeros(30, 40, dtype=torch.bool)
    mask[5:25, 10:20] = True
    assert box_of(mask) == (9, 4, 21, 26)
    x, y = point_in(mask)
    assert 14 <= x <= 15 and 9 <= y <= 20
    cut = torch.zeros_like(mask)
    cut[:, :30] = True
    assert clearest_view([mask[:10] & False, mask, cut]) == 1 and clearest_view([mask & False, cut]) == 1
