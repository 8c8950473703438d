import pytest
import torch

from freqgs_plugin.studio.run_files import latest_checkpoint, read_config


@pytest.fixture
def run(tmp_path):
    """A run's folder with two checkpoints, and what people leave beside them."""
    folder = tmp_path / "nerfstudio_models"
    folder.mkdir()
    for step in (9, 1_000_000_000):
        torch.save({"x": torch.arange(5000.0)}, folder / f"step-{step:09d}.ckpt")
    for name in ("notes.txt", "step-latest.ckpt", "step-7.ckpt", "step-000000010.ckpt.part", ".DS_Store"):
        (folder / name).write_text("no checkpoint")
    return tmp_path


def test_the_newest_checkpoint(run):
    path, step = latest_checkpoint(run)
    assert (path.name, step) == ("step-1000000000.ckpt", 1_000_000_000)


def test_a_run_without_one(tmp_path):
    with pytest.raises(FileNotFoundError, match="has not saved a checkpoint yet"):
        latest_checkpoint(tmp_path)


@pytest.mark.parametrize("damage", [lambda b: b"", lambda b: b[:5000], lambda b: b[:8000] + bytes(4096) + b[12096:]])
def test_a_damaged_one_is_named(run, damage):
    """Cut off, or with a lost block: torch loads that as zeros."""
    path, _ = latest_checkpoint(run)
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(ValueError, match=rf"{path} cannot be loaded: it is truncated or damaged .* Copy it again"):
        latest_checkpoint(run)
    path.unlink()
    assert latest_checkpoint(run)[1] == 9


@pytest.mark.parametrize("text", ["", "hello", "[1, 2]", "method_name: lapsplat"])
def test_a_config_of_something_else(tmp_path, text):
    path = tmp_path / "config.yml"
    path.write_text(text)
    with pytest.raises(ValueError, match=rf"{path} holds no settings of ns-train .* copy the run again"):
        read_config(path)


def test_no_config(tmp_path):
    with pytest.raises(FileNotFoundError, match="is no file; name the config.yml"):
        read_config(tmp_path)
