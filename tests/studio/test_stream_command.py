"""`freqgs export --format stream` and `html` of trained runs."""

import json
import re

import pytest
import torch

from freqgs_plugin.cli import main
from freqgs_plugin.stream.client import fetch
from freqgs_plugin.studio.checkpoint import load_run

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("method", ["trained", "faded"])
def test_a_run_is_streamed(method, request, tmp_path):
    config = request.getfixturevalue(method)
    run = load_run(config)
    arguments = ["export", "--load-config", str(config), "--format", "stream", "--output-dir", str(tmp_path)]
    main([*arguments, "--variant", "exact"])
    received = fetch(tmp_path / "stream").received
    manifest, found = received.manifest, received.gaussians()
    assert manifest.antialiased == run.antialiased and manifest.scene_distance == run.scene_distance
    assert [view["name"] for view in manifest.views] == [view.name for view in run.cameras("test")]
    own = run.gaussians
    assert found.signed_residuals == own.signed_residuals
    assert torch.equal(torch.bincount(found.level.long()), torch.bincount(own.level.long()))
    for mine, theirs in ((found.means, own.means), (found.features_rest, own.features_rest)):
        assert torch.equal(mine.flatten().sort().values, theirs.detach().flatten().sort().values)
    told = json.loads((tmp_path / "stream" / "export.json").read_text(encoding="utf-8"))["files"]["stream"]
    assert told["gaussians"] == len(own) and told["loss"]["classic_viewers"]["same_pictures"]
    with pytest.raises(SystemExit):
        main(arguments)
    assert fetch(tmp_path / "stream").received.count == len(own)


def test_a_run_is_one_page(trained, tmp_path, capsys):
    arguments = ["export", "--load-config", str(trained), "--format", "html", "--output-dir", str(tmp_path)]
    with pytest.raises(SystemExit):
        main([*arguments, "--bake"])
    assert "--bake: the page draws the scene as it is trained" in re.sub(r"\s+", " ", capsys.readouterr().err)
    main([*arguments, "--level", "1"])
    page = (tmp_path / "scene.html").read_text(encoding="utf-8")
    told = json.loads((tmp_path / "scene.html.json").read_text(encoding="utf-8"))["files"]["scene.html"]
    assert 'src="' not in page and 20 < told["loss"]["classic_viewers"]["psnr_to_our_pictures"] < 120
    assert told["gaussians"] == int((load_run(trained).gaussians.level == 1).sum())
