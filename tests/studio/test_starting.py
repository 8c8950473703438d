"""Training that starts from an exported scene or from another run."""

import pytest

from freqgs_plugin.io.ply import SplatFileError
from freqgs_plugin.studio.starting import RunFacts, read_start, run_facts

RUN = """!!python/object:nerfstudio.engine.trainer.TrainerConfig
data: &id001 !!python/object/apply:pathlib.PosixPath
- /
pipeline: !!python/object:nerfstudio.pipelines.base_pipeline.VanillaPipelineConfig
  datamanager:
    data: *id001
  model: !!python/object:some.Model
    _target: !!python/name:no.such.module ''
    rasterize_mode: {mode}
{more}
method_name: something
"""


def test_a_runs_config_is_read_without_making_its_objects(tmp_path):
    (tmp_path / "nerfstudio_models").mkdir()
    checkpoint = tmp_path / "nerfstudio_models" / "step-1.ckpt"
    for mode, more, expected in (
        ("antialiased", "    signed_residuals: false", RunFacts(False, True)),
        ("classic", "    signed_residuals: true", RunFacts(True, False)),
        ("classic", "    other: 1", RunFacts(None, False)),
    ):
        (tmp_path / "config.yml").write_text(RUN.format(mode=mode, more=more))
        for path in (tmp_path, tmp_path / "config.yml", checkpoint.parent, checkpoint):
            assert run_facts(path) == expected
    assert run_facts(tmp_path / "far" / "away" / "from" / "it") == RunFacts()


@pytest.mark.slow
def test_a_real_run_of_several_levels_is_refused(trained):
    with pytest.raises(SplatFileError, match="whose colours above level 1 are signed residuals: w"):
        read_start(trained)
