"""Checkpoints of a training: whole or not there, and looked at before they are loaded."""

import pytest
import torch
from running import advance

from freqgs_plugin.studio.run_files import latest_checkpoint
from freqgs_plugin.studio.trainer import SplatTrainer


@pytest.fixture
def trainer(make_trainer):
    """One that has saved step 1."""
    trainer = make_trainer()
    assert isinstance(trainer, SplatTrainer)
    advance(trainer, 2)
    trainer.save_checkpoint(1)
    return trainer


def names(trainer):
    run = trainer.checkpoint_dir.parent
    assert not list(run.glob(".*")), "something is left of a checkpoint that was not finished"
    return sorted(path.name for path in trainer.checkpoint_dir.iterdir())


def test_only_the_latest_checkpoint_stays(trainer):
    trainer.save_checkpoint(2)
    assert names(trainer) == ["step-000000002.ckpt"]
    assert latest_checkpoint(trainer.checkpoint_dir.parent)[1] == 2


def test_or_all_of_them(trainer):
    trainer.config.save_only_latest_checkpoint = False
    trainer.save_checkpoint(2)
    assert names(trainer) == ["step-000000001.ckpt", "step-000000002.ckpt"]


def fails_half_way(failure):
    def save(content, path):
        path.write_bytes(b"half of it")
        raise failure

    return save


def test_a_full_disk_leaves_the_last_one(trainer, monkeypatch):
    monkeypatch.setattr(torch, "save", fails_half_way(RuntimeError("unexpected pos 64 vs 0")))
    with pytest.raises(
        OSError,
        match=r"step-000000002\.ckpt cannot be written to .*the last one, step-000000001\.ckpt, with --load-dir",
    ):
        trainer.save_checkpoint(2)
    assert names(trainer) == ["step-000000001.ckpt"]
    assert latest_checkpoint(trainer.checkpoint_dir.parent)[1] == 1


def test_so_does_an_interrupt(trainer, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(torch, "save", fails_half_way(KeyboardInterrupt()))
        with pytest.raises(KeyboardInterrupt):
            trainer.save_checkpoint(2)
    assert names(trainer) == ["step-000000001.ckpt"]
    trainer.save_checkpoint(2)
    assert names(trainer) == ["step-000000002.ckpt"]


def test_a_truncated_checkpoint_is_named_where_training_goes_on(trainer, make_trainer):
    folder = trainer.checkpoint_dir
    path = folder / "step-000000001.ckpt"
    path.write_bytes(path.read_bytes()[:-200])
    for edit in (
        lambda config: setattr(config, "load_dir", folder),
        lambda config: (setattr(config, "load_dir", folder), setattr(config, "load_step", 1)),
        lambda config: setattr(config, "load_checkpoint", path),
    ):
        with pytest.raises(ValueError, match=r"step-000000001\.ckpt cannot be loaded: it is truncated or damaged"):
            make_trainer(edit=edit)
