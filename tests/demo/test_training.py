import subprocess
import sys

import pytest

from freqgs_plugin.demo.training import TrainingError, TrainingRun, train
from freqgs_plugin.reports import child as process


@pytest.fixture
def run(tmp_path):
    return TrainingRun(tmp_path / "scene", tmp_path / "runs", steps=200, seed=3, levels=2, timestamp="now")


def child(monkeypatch, code):
    """Put a small program in the place of ns-train."""
    real = subprocess.Popen
    monkeypatch.setattr(
        process.subprocess, "Popen", lambda command, **more: real([sys.executable, "-uc", code], **more)
    )


OUTPUT = """
print("Step (% Done)       Train Iter (time)    ETA (time)")
print("0 (0.00%)           516.392 ms           41 s")
print("[00:34:46] Step 7: level 2 of 2 begins with 4,000 Gaussians")
print("10 (5.00%)          59.127 ms            4 s")
"""


def test_steps_and_stages_are_read_from_the_output_and_kept_in_the_log(monkeypatch, run, tmp_path):
    run.folder.mkdir(parents=True)
    run.config_path.touch()
    child(monkeypatch, OUTPUT)
    seen = []
    train(run, tmp_path / "log", lambda step, stage: seen.append((step, stage)))
    assert seen == [(0, None), (0, "training level 2 of 2"), (10, None)]
    log = (tmp_path / "log").read_text()
    assert "nerfstudio.scripts.train lapsplat" in log.splitlines()[0] and "59.127 ms" in log


def test_failure_shows_the_end_of_the_log(monkeypatch, run, tmp_path):
    child(monkeypatch, "print('out of cheese'); raise SystemExit(3)")
    with pytest.raises(TrainingError, match=r"exit status 3.*log; the end:\n(.|\n)*out of cheese"):
        train(run, tmp_path / "log", lambda *_: None)


def test_a_run_without_a_config_is_a_failure(monkeypatch, run, tmp_path):
    child(monkeypatch, "pass")
    with pytest.raises(TrainingError, match="exit status 0"):
        train(run, tmp_path / "log", lambda *_: None)


def test_an_interrupt_ends_the_child(monkeypatch, run, tmp_path):
    child(monkeypatch, "import time; print('0 (0.00%)'); time.sleep(60)")
    children = []
    popen = process.subprocess.Popen
    monkeypatch.setattr(process.subprocess, "Popen", lambda *a, **k: children.append(popen(*a, **k)) or children[0])

    def interrupt(*_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(run, tmp_path / "log", interrupt)
    assert children[0].poll() is not None


def test_resume_hint_names_the_checkpoints_once_there_are_any(run):
    assert "No checkpoint" in run.resume_hint()
    (run.folder / "nerfstudio_models").mkdir(parents=True)
    (run.folder / "nerfstudio_models" / "step-000000050.ckpt").touch()
    hint = run.resume_hint()
    assert "ns-train lapsplat" in hint and f"--load-dir {run.folder / 'nerfstudio_models'}" in hint
    assert hint.index("--load-dir") < hint.index(" colmap ")
