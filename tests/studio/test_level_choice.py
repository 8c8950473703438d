"""lapsplat with a number of levels that it chooses itself, and with levels that must gain something."""

import pytest
import torch
from running import advance, save
from state import consistent

from freqgs_plugin.training.schedule import scaled

pytestmark = pytest.mark.slow


def test_auto_is_chosen_logged_and_stored(make_trainer, said):
    trainer = make_trainer(num_levels="auto", auto_share=0.0)
    model = trainer.pipeline.model
    assert model._num_levels == 3 and model._level_choice["kept"] == [True, True]
    assert any("3 levels (at most 3, since images of 80x64 px" in line for line in said)
    advance(trainer, 2)
    folder = save(trainer)
    said.clear()
    # without auto's budget: the checkpoint says it
    resumed = make_trainer(load_dir=folder, num_levels="auto", auto_share=100.0)
    again = resumed.pipeline.model
    assert again._num_levels == 3 and again.level_choice() == model.level_choice() != {}
    assert again.controls.slider.max == 3.0
    advance(resumed, 1)
    consistent(resumed)
    assert not any("levels (at most" in line for line in said)


def test_bands_without_energy_get_no_level(make_trainer, said):
    trainer = make_trainer(num_levels="auto", auto_share=1e6)
    model = trainer.pipeline.model
    assert model._num_levels == 1
    assert any(line.startswith("1 level (") and "dropped" in line for line in said)
    advance(trainer, 1)


@pytest.mark.parametrize(("least", "levels"), [(1000.0, 2), (1e-6, 3)])
def test_a_level_that_gains_little_is_the_last(make_trainer, said, least, levels):
    trainer = make_trainer(least_level_gain=least, steps_scale=0.002)
    model, manager = trainer.pipeline.model, trainer.pipeline.datamanager
    # of six views none would be
    assert any("fewer than 8 views" in line for line in said) and not manager.held_back
    manager.hold_back({1, 4})
    model._gain._manager = manager
    stage = scaled(2500, 0.002)
    with torch.no_grad():
        # what the second level gains is decided here
        model._gain.measure = lambda m: None if m._stage == 1 else 1.0
    seen = []
    advance(trainer, 2 * stage + 2, before=lambda step: seen.append(set(manager.train_unseen_cameras) & {1, 4}))
    assert model._stage == model._num_levels == model.num_levels == levels
    assert not any(seen[: 2 * stage - 1]) and not manager.held_back
    assert model._halvings() == 0
    assert ("stopped" in model._level_choice) == (levels == 2)
    assert any("gained 1.00 dB on 2 views" in line for line in said) == (levels == 2)
    consistent(trainer)


def test_gains_are_differences_of_psnr(make_trainer):
    from freqgs_plugin.studio.level_gain import LevelGain

    trainer = make_trainer()
    model, gain = trainer.pipeline.model, LevelGain()
    trainer.pipeline.datamanager.hold_back({2})
    gain._manager = trainer.pipeline.datamanager
    assert gain.measure(model) is None and gain.last is not None
    assert gain.measure(model) == pytest.approx(0.0, abs=1e-6) and model.training
    gain.release()
    assert not gain.active and 2 in trainer.pipeline.datamanager.train_unseen_cameras


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *((name, float("nan")) for name in ("auto_psnr", "auto_share", "least_level_gain", "dft_weight")),
        *(("image_weight", float("inf")), ("lower_level_weight", -1.0), ("coarse_growth_factor", 0.0)),
        *(("new_level_opacity", value) for value in (0.0, 1.0, 2.0, float("nan"))),
        *(("opacity_penalty", float("nan")), ("split_screen_size", float("nan")), ("densify_grad_thresh", 0.0)),
        *((name, -1) for name in ("size_penalty", "least_weight", "max_gaussians", "target_cache_mb", "seed")),
    ],
)
def test_impossible_settings(make_trainer, name, value):
    with pytest.raises(ValueError, match=f"{name} is {value}; it must be"):
        make_trainer(**{name: value})


def test_the_base_is_bounded_in_the_last_stage(make_trainer):
    """And the picture of all levels stays the same."""
    trainer = make_trainer(base_share=0.1)
    model = trainer.pipeline.model
    half = len(model.level) // 2
    with torch.no_grad():
        model.level[half:] = 3
        # grey, so that no colour is clamped at 0
        model.gauss_params["features_dc"][:half] = 0.0
    model._stage = model._num_levels = 3
    camera = trainer.pipeline.datamanager.train_dataset.cameras[:1]

    def picture():
        model.eval()
        return model.get_outputs_for_camera(camera)["rgb"]

    before = picture()
    moved = model._bound_base()
    counts = model.level_counts()
    assert moved == counts[1] == half - counts[0] and counts[0] == int(0.1 * len(model.level)) > 0
    assert torch.allclose(picture(), before, atol=1e-4)
    assert model._bound_base() == 0


@pytest.mark.parametrize("share", [0.0, -1.0, 1.5, float("nan")])
def test_a_share_of_the_base_is_a_share(make_trainer, share):
    with pytest.raises(ValueError, match="base_share is"):
        make_trainer(base_share=share)
