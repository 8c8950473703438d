"""`freqgs stream` of trained runs."""

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
    main(["stream", "--load-config", str(config), "--output-dir", str(tmp_path), "--variant", "exact"])
    received = fetch(tmp_path).received
    manifest, found = received.manifest, received.gaussians()
    assert manifest.antialiased == run.antialiased and manifest.scene_distance == run.scene_distance
    assert [view["name"] for view in manifest.views] == [view.name for view in run.cameras("test")]
    own = run.gaussians
    assert found.signed_residuals == own.signed_residuals
    assert torch.equal(torch.bincount(found.level.long()), torch.bincount(own.level.long()))
    for mine, theirs in ((found.means, own.means), (found.features_rest, own.features_rest)):
        assert torch.equal(mine.flatten().sort().values, theirs.detach().flatten().sort().values)
