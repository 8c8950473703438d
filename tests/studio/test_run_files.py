import pytest
import torch

from freqgs_plugin.studio.run_files import in_one_piece, latest_checkpoint, read_config, save_checkpoint


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
    with pytest.raises(FileNotFoundError, match=r"is no file; name the config\.yml"):
        read_config(tmp_path)


def test_a_run_appears_whole(tmp_path):
    run = tmp_path / "new" / "lapsplat" / "run"
    with in_one_piece(run) as partial:
        (partial / "config.yml").write_text("x")
        assert not run.exists()
    assert [path.name for path in run.parent.iterdir()] == ["run"] and (run / "config.yml").is_file()
    # two imports in the same second
    with pytest.raises(FileExistsError, match="has appeared meanwhile"), in_one_piece(run):
        pass
    assert [path.name for path in run.parent.iterdir()] == ["run"] and len(list(run.iterdir())) == 1


@pytest.mark.parametrize("failure", [KeyboardInterrupt, OSError])
def test_nor_does_a_part_of_it_stay(tmp_path, failure):
    with pytest.raises(failure), in_one_piece(tmp_path / "new" / "lapsplat" / "run") as partial:
        (partial / "config.yml").write_text("x")
        raise failure
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_is_named(tmp_path, monkeypatch):
    def fail(content, path):
        raise RuntimeError("unexpected pos 64 vs 0")

    monkeypatch.setattr(torch, "save", fail)
    with pytest.raises(OSError, match=r"step-000000000\.ckpt cannot be written to .*run .* Make room"):
        save_checkpoint({}, tmp_path / "step-000000000.ckpt", tmp_path / "run")
