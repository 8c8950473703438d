"""The model under nerfstudio's own Trainer, stepped by hand."""

import dataclasses

import numpy as np
import pytest
import torch
from nerfstudio.data.scene_box import OrientedBox
from PIL import Image
from running import SIZE, advance, save
from state import all_finite, consistent, optimizer_state, parameters, same, statistics

from freqgs_plugin.training.guard import NonFiniteError

pytestmark = pytest.mark.slow

GROUPS = ("means", "scales", "quats", "features_dc", "features_rest", "opacities")
SHORT = {"steps_scale": 0.004, "least_refine_interval": 4}
"""levels begin at steps 10 and 20"""


class TestStages:
    def test_levels_and_resolution(self, make_trainer, said):
        trainer = make_trainer(**SHORT)
        model = trainer.pipeline.model
        seen = []
        for _ in range(30):
            _, losses, metrics = advance(trainer, 1)
            seen.append((metrics["stage"], metrics["width"], metrics["height"], tuple(sorted(losses))))
            consistent(trainer)
        w, h = SIZE
        penalties = ("opacity", "size")
        assert seen[:10] == [(1, w // 4, h // 4, ("image_1", *penalties))] * 10
        assert seen[10:20] == [(2, w // 2, h // 2, ("dft", "image_1", "image_2", *penalties))] * 10
        assert seen[20:] == [(3, w, h, ("dft", "image_1", "image_2", "image_3", *penalties))] * 10
        assert model.level_counts() == [metrics[f"gaussians_level_{k}"] for k in (1, 2, 3)]
        assert sum(model.level_counts()) == metrics["gaussian_count"] == model.num_points
        begins = [line for line in said if "begins" in line]
        assert len(begins) == 2 and "Step 20: level 3 of 3 begins" in begins[1] and "1/1 size" in begins[1]
        assert any("Step constants are multiplied by 0.004" in line for line in said)

    def test_pictures_are_always_at_true_size(self, make_trainer):
        trainer = make_trainer(**SHORT)
        for _ in range(3):
            advance(trainer, 10)
            metrics, images = trainer.pipeline.get_eval_image_metrics_and_images(trainer.step)
            assert images["img"].shape == (SIZE[1], 2 * SIZE[0], 3)
            assert all(np.isfinite(v) for v in metrics.values())
            _, losses, metrics = trainer.pipeline.get_eval_loss_dict(trainer.step)
            assert metrics["width"] == SIZE[0] and all(np.isfinite(float(v)) for v in losses.values())
            assert trainer.pipeline.model.training

    def test_one_resolution(self, make_trainer):
        trainer = make_trainer(multiresolution=False, **SHORT)
        assert {advance(trainer, 1)[2]["width"] for _ in range(22)} == {SIZE[0]}

    def test_a_new_level_is_a_copy_and_optimizers_restart(self, make_trainer):
        trainer = make_trainer(**SHORT)
        model = trainer.pipeline.model
        advance(trainer, 10)
        before, n = parameters(model), model.num_points
        rate = trainer.optimizers.optimizers["means"].param_groups[0]["lr"]
        seen = {}

        def look(step):
            seen["level"] = model.level.clone()
            seen["parameters"] = parameters(model)
            seen["states"] = [v for o in trainer.optimizers.optimizers.values() for v in o.state.values() if v]
            seen["rate"] = trainer.optimizers.optimizers["means"].param_groups[0]["lr"]

        advance(trainer, 1, look)
        assert seen["level"].tolist() == [1] * n + [2] * n
        for name, value in before.items():
            assert torch.equal(seen["parameters"][name], torch.cat([value, value]))
        assert seen["states"] == []
        assert seen["rate"] == pytest.approx(1.6e-4) and rate < seen["rate"]

    def test_children_and_the_pruned(self, make_trainer):
        """Levels follow their Gaussians: colours that say the level still say it after every operation."""
        trainer = make_trainer(growth="all", densify_grad_thresh=1e-6, reset_alpha_every=1000, **SHORT)
        model = trainer.pipeline.model
        advance(trainer, 21)
        counts = []
        with torch.no_grad():
            # the colour says which level a Gaussian is of
            model.gauss_params["features_dc"][:] = model.level[:, None].float() * 10
            model.gauss_params["opacities"][::7] = -10.0
        for group in trainer.optimizers.optimizers["features_dc"].param_groups:
            group["lr"] = 0.0
        for _ in range(9):
            advance(trainer, 1)
            consistent(trainer)
            counts.append(model.level_counts())
            colour = model.gauss_params["features_dc"].detach()
            torch.testing.assert_close(colour, model.level[:, None].float().expand_as(colour) * 10)
        assert len({tuple(c) for c in counts}) > 1

    def test_level_prune_and_save_on_one_step(self, make_trainer):
        settings = {**SHORT, "least_refine_interval": 5, "reset_alpha_every": 1000}
        trainer = make_trainer(**settings)
        model = trainer.pipeline.model
        model.schedule = dataclasses.replace(model.schedule, refine_pause=0)
        advance(trainer, 10)
        with torch.no_grad():
            model.gauss_params["opacities"][:20] = -10.0
        n = model.num_points
        advance(trainer, 1)
        assert model.schedule.refines(10) and model.num_levels == 2
        assert model.num_points != 2 * n and float(model.opacities.min()) > -9
        consistent(trainer)
        other = make_trainer(load_dir=save(trainer), **settings)
        assert torch.equal(other.pipeline.model.level, model.level)
        assert same(parameters(other.pipeline.model), parameters(model))
        consistent(other)
        advance(other, 15)
        consistent(other)
        assert other.pipeline.model.num_levels == 3

    def test_fewer_levels_on_small_images(self, make_trainer, tmp_path, said):
        from freqgs_plugin.demo.dataset import SceneOptions, write_scene

        write_scene(tmp_path / "tiny", SceneOptions(8, 40, 32, 60, 1), progress=False)
        trainer = make_trainer(data=tmp_path / "tiny", **SHORT)
        advance(trainer, 25)
        assert trainer.pipeline.model.num_levels == 2
        assert any(line.find("2 levels instead of 3") >= 0 for line in said)


class TestCheckpoints:
    @pytest.mark.parametrize("steps", [3, 10, 11, 17, 21, 29])
    def test_a_resumed_run_is_the_same_run(self, make_trainer, steps):
        """In every stage, just before and just after one begins: state is bit-exact, and so are the next steps."""
        settings = {**SHORT, "camera_optimizer": "SO3xR3"}
        first = make_trainer(**settings)
        advance(first, steps)
        second = make_trainer(load_dir=save(first), **settings)
        a, b = first.pipeline.model, second.pipeline.model
        assert second._start_step == steps and (a.num_levels, a.step) == (b.num_levels, b.step)
        consistent(second)

        def compare():
            assert torch.equal(a.level, b.level)
            assert same(parameters(a), parameters(b))
            assert same(optimizer_state(first), optimizer_state(second))
            assert same(statistics(a), statistics(b))
            assert a._sh_degree == b._sh_degree and a.schedule == b.schedule

        compare()
        order = [0, 1, 2, 3, 4, 5] * 3
        for trainer in (first, second):
            trainer.pipeline.datamanager.train_unseen_cameras = list(order)
            torch.manual_seed(1)
            advance(trainer, 6)
        compare()

    def test_pictures_survive(self, make_trainer):
        first = make_trainer(**SHORT)
        advance(first, 25)
        second = make_trainer(load_dir=save(first), **SHORT)
        pictures = []
        for trainer in (first, second):
            trainer.pipeline.eval()
            camera, _ = trainer.pipeline.datamanager.fixed_indices_eval_dataloader[1]
            pictures.append(dict(trainer.pipeline.model.get_outputs_for_camera(camera)))
        assert same(*pictures)

    def test_a_run_of_another_length_keeps_its_schedule(self, make_trainer):
        first = make_trainer(steps_scale=None)
        assert first.pipeline.model.schedule.level_interval == round(2500 * 150 / 30_000)
        advance(first, 2)

        def longer(config):
            config.max_num_iterations = 3000

        second = make_trainer(load_dir=save(first), steps_scale=None, edit=longer)
        assert second.pipeline.model.schedule == first.pipeline.model.schedule

    def test_another_method_is_refused(self, make_trainer):
        trainer = make_trainer()
        state = trainer.pipeline.state_dict()
        foreign = {k: v for k, v in state.items() if not k.endswith(("level", "_extra_state"))}
        with pytest.raises(ValueError, match="not made by this method"):
            trainer.pipeline.load_pipeline(foreign, 10)


class TestGuard:
    @pytest.mark.parametrize("group", GROUPS)
    def test_a_bad_gradient_is_skipped(self, make_trainer, said, group):
        trainer = make_trainer(camera_optimizer="SO3xR3", **SHORT)
        model = trainer.pipeline.model
        advance(trainer, 12)
        rows = torch.where(model.level == 2)[0][:3]

        def spoil(step):
            def bad(grad):
                grad = grad.clone()
                grad[rows] = torch.nan
                return grad

            model.gauss_params[group].register_hook(bad)

        before, poses = parameters(model), model.camera_optimizer.pose_adjustment.detach().clone()
        state = {k: v.clone() for k, v in optimizer_state(trainer).items() if "exp" in k}
        advance(trainer, 1, spoil)
        assert same(parameters(model), before)
        assert torch.equal(model.camera_optimizer.pose_adjustment, poses)
        assert all(torch.equal(v, optimizer_state(trainer)[k]) for k, v in state.items())
        (message,) = [line for line in said if "not finite" in line]
        assert (
            f"step 12: not finite: gradient of '{group}' at 3 of {model.num_points} Gaussians (3 of level 2)" in message
        )
        assert "skipped" in message
        assert model.guard.skipped == 1
        if group in ("features_dc", "opacities"):
            model.gauss_params[group]._backward_hooks.clear()
            advance(trainer, 3)
            assert model.guard.skipped == 1 and all_finite(model)
            assert not same(parameters(model), before)

    def test_bad_camera_gradients_are_skipped_too(self, make_trainer, said):
        trainer = make_trainer(camera_optimizer="SO3xR3", use_bilateral_grid=True, **SHORT)
        model = trainer.pipeline.model
        advance(trainer, 3)
        before = {n: p.detach().clone() for n, p in model.named_parameters()}
        model.camera_optimizer.pose_adjustment.register_hook(lambda grad: grad * torch.nan)
        advance(trainer, 1)
        assert same({n: p.detach() for n, p in model.named_parameters()}, before)
        assert any("gradient of 'camera_optimizer.pose_adjustment'" in line for line in said)

    def test_a_bad_image_names_the_losses_and_does_not_last(self, make_trainer, said):
        trainer = make_trainer(**SHORT)
        model, manager = trainer.pipeline.model, trainer.pipeline.datamanager
        image = manager.cached_train[2]["image"].float() / 255
        image[5, 5] = torch.nan
        manager.cached_train[2]["image"] = image
        advance(trainer, 24)
        assert model.guard.skipped >= 3 and all_finite(model)
        (message,) = [line for line in said if "not finite" in line]
        assert "loss image_1" in message
        consistent(trainer)

    def test_what_persists_ends_the_run_with_a_checkpoint(self, make_trainer):
        trainer = make_trainer(bad_steps_patience=4, **SHORT)
        model = trainer.pipeline.model
        advance(trainer, 7)
        before = parameters(model)
        for batch in trainer.pipeline.datamanager.cached_train:
            batch["image"] = torch.full_like(batch["image"], 0, dtype=torch.float32) * torch.nan
        model._targets.clear()
        with pytest.raises(NonFiniteError, match=r"4 steps in a row .*now step 10.* step 7: .*image_1") as caught:
            advance(trainer, 20)
        assert "Lower the learning rates" in str(caught.value)
        (file,) = trainer.checkpoint_dir.glob("step-*.ckpt")
        assert file.name == "step-000000010.ckpt"
        other = make_trainer(load_dir=trainer.checkpoint_dir, **SHORT)
        assert all_finite(other.pipeline.model)
        if other.pipeline.model.num_levels == 1:
            assert same(parameters(other.pipeline.model), before)
        advance(other, 5)


ABLATIONS = {
    "no frequency term": {"dft_weight": 0.0},
    "no lower levels": {"lower_level_weight": 0.0},
    "neither": {"dft_weight": 0.0, "lower_level_weight": 0.0},
    "unsigned": {"signed_residuals": False},
    "one level": {"num_levels": 1},
    "two levels": {"num_levels": 2},
    "newest grows": {"growth": "newest"},
    "own prefix grows": {"growth": "own_prefix"},
    "own prefix without its loss": {"growth": "own_prefix", "lower_level_weight": 0.0},
    "all grow": {"growth": "all"},
    "hard clamp": {"clamp_in_loss": "hard"},
    "straight through": {"clamp_in_loss": "straight_through"},
    "orthonormal": {"dft_norm": "ortho"},
    "newest reset": {"reset_levels": "newest"},
    "all reset": {"reset_levels": "all"},
    "schedules run on": {"restart_schedulers": False},
    "faint new level": {"new_level_opacity": 0.1},
    "no absgrad": {"use_absgrad": False},
    "classic": {"rasterize_mode": "classic"},
    "bounded": {"max_gaussians": 320},
    "white background": {"background_color": "white"},
    "no harmonics": {"sh_degree": 0},
    "scale regularization": {"use_scale_regularization": True},
    "no target cache": {"target_cache_mb": 0},
    "torch": {"rasterizer": "torch", "growth": "own_prefix"},
    "camera poses SO3xR3": {"camera_optimizer": "SO3xR3"},
    "camera poses SE3": {"camera_optimizer": "SE3"},
    "bilateral grid": {"use_bilateral_grid": True},
}


@pytest.mark.parametrize("name", ABLATIONS)
def test_switches(make_trainer, name):
    trainer = make_trainer(**{**SHORT, **ABLATIONS[name]})
    model = trainer.pipeline.model
    first = {n: p.detach().clone() for n, p in model.named_parameters() if not n.startswith("gauss")}
    total, losses, metrics = advance(trainer, 26)
    consistent(trainer)
    assert bool(torch.isfinite(total)) and all_finite(model) and model.guard.skipped == 0
    settings = ABLATIONS[name]
    levels = settings.get("num_levels", 3)
    assert metrics["stage"] == levels
    images = (
        {f"image_{levels}"} if settings.get("lower_level_weight") == 0 else {f"image_{k}" for k in range(1, levels + 1)}
    )
    assert {key for key in losses if key.startswith("image_")} == images
    assert ("dft" in losses) == (settings.get("dft_weight") != 0 and levels > 1)
    if "max_gaussians" in settings:
        # two new levels double what is there
        assert model.num_points < 2 * 2 * 2 * 320
    if "camera" in name or "grid" in name:
        moved = [n for n, p in model.named_parameters() if n in first and p.numel() and not torch.equal(p, first[n])]
        assert moved, f"nothing but Gaussians moved: {list(first)}"
        trainer.pipeline.get_average_eval_image_metrics()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"num_levels": 0}, "num_levels is 0"),
        ({"level_interval": 0}, "level_interval is 0"),
        ({"sh_degree": 7}, "sh_degree is 7"),
        ({"steps_scale": 0.0}, "steps_scale is 0.0"),
        ({"steps_scale": float("nan")}, "steps_scale is nan"),
        ({"rasterize_mode": "smooth"}, "rasterize_mode is 'smooth'; choose antialiased or classic"),
    ],
)
def test_settings_that_cannot_be(make_trainer, settings, message):
    with pytest.raises(ValueError, match=message):
        make_trainer(**settings)


def test_mcmc_is_refused_with_the_reason(make_trainer):
    with pytest.raises(ValueError, match=r"'mcmc' does not work with lapsplat: MCMC moves .* default strategy"):
        make_trainer(strategy="mcmc")


def test_an_unknown_rasterizer_is_refused(make_trainer):
    trainer = make_trainer(rasterizer="voxels")
    with pytest.raises(ValueError, match="voxels"):
        advance(trainer, 1)


class TestPictures:
    def test_outputs(self, make_trainer):
        trainer = make_trainer(**SHORT)
        advance(trainer, 25)
        trainer.pipeline.eval()
        camera, batch = trainer.pipeline.datamanager.fixed_indices_eval_dataloader[0]
        model = trainer.pipeline.model
        outputs = model.get_outputs_for_camera(camera)
        names = ["rgb", "depth", "accumulation", "background", *(f"prefix_{k}" for k in (1, 2, 3))]
        names += [*(f"band_{k}" for k in (1, 2, 3)), "levels"]
        assert list(outputs) == names
        for name, value in outputs.items():
            assert value.shape == (SIZE[1], SIZE[0], 1 if name in ("depth", "accumulation") else 3), name
            assert bool(value.isfinite().all()) and float(value.min()) >= 0, name
            assert name == "depth" or float(value.max()) <= 1, name
        assert torch.equal(outputs["prefix_3"], outputs["rgb"]) and torch.equal(outputs["band_1"], outputs["prefix_1"])
        metrics, _ = model.get_image_metrics_and_images(outputs, batch)
        assert metrics["gaussians_prefix_3"] == metrics["gaussians"] == model.num_points
        assert metrics["gaussians_prefix_2"] == sum(model.level_counts()[:2])
        assert metrics["psnr_prefix_3"] == pytest.approx(metrics["psnr"], abs=1e-4)
        assert metrics["lpips_computed"] in (0.0, 1.0) and ("lpips" in metrics) == bool(metrics["lpips_computed"])

    def test_levels_to_come_have_outputs_already(self, make_trainer):
        trainer = make_trainer(**SHORT)
        advance(trainer, 3)
        trainer.pipeline.eval()
        camera, batch = trainer.pipeline.datamanager.fixed_indices_eval_dataloader[0]
        outputs = trainer.pipeline.model.get_outputs_for_camera(camera)
        assert torch.equal(outputs["prefix_3"], outputs["prefix_1"])
        assert float((outputs["band_3"] - 0.5).abs().max()) < 1e-6
        metrics, _ = trainer.pipeline.model.get_image_metrics_and_images(outputs, batch)
        assert metrics["gaussians_level_3"] == 0

    def test_crop_box(self, make_trainer):
        trainer = make_trainer(**SHORT)
        advance(trainer, 25)
        trainer.pipeline.eval()
        model = trainer.pipeline.model
        camera, _ = trainer.pipeline.datamanager.fixed_indices_eval_dataloader[0]
        whole = model.get_outputs_for_camera(camera)
        big = OrientedBox.from_params((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (50.0, 50.0, 50.0))
        assert torch.equal(model.get_outputs_for_camera(camera, big)["rgb"], whole["rgb"])

        centre = tuple(model.means.detach().median(0).values.tolist())
        half = OrientedBox.from_params(centre, (0.3, 0.2, 0.1), (0.5, 0.5, 0.5))
        inside = half.within(model.means).flatten()
        assert 0 < int(inside.sum()) < model.num_points
        cropped = dict(model.get_outputs_for_camera(camera, half))
        with torch.no_grad():
            model.gauss_params["opacities"][~inside] = -50.0
            alone = dict(model.get_outputs_for_camera(camera))
        for name in ("rgb", "prefix_1", "prefix_2", "band_2", "levels", "accumulation"):
            torch.testing.assert_close(cropped[name], alone[name], msg=name)
        assert not torch.equal(cropped["rgb"], whole["rgb"])

    def test_an_empty_crop_box_shows_the_background(self, make_trainer):
        trainer = make_trainer(**SHORT)
        advance(trainer, 2)
        trainer.pipeline.eval()
        camera, _ = trainer.pipeline.datamanager.fixed_indices_eval_dataloader[0]
        nowhere = OrientedBox.from_params((1e3, 0.0, 0.0), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
        outputs = dict(trainer.pipeline.model.get_outputs_for_camera(camera, nowhere))
        assert torch.equal(outputs["rgb"], outputs["background"])
        assert float(outputs["accumulation"].max()) == 0 and bool(outputs["depth"].isfinite().all())
        assert float(outputs["levels"].max()) == 0

    def test_something_that_is_no_camera(self, make_trainer):
        with pytest.raises(TypeError, match="Cameras"):
            make_trainer().pipeline.model.get_outputs("camera")


def write_masks(scene, hidden):
    (scene / "masks").mkdir()
    for path in (scene / "images").iterdir():
        mask = np.full((SIZE[1], SIZE[0]), 255, np.uint8)
        mask[:, hidden] = 0
        Image.fromarray(mask).save(scene / "masks" / path.name)


class TestImages:
    def test_what_is_masked_does_not_count(self, make_trainer, own_scene):
        hidden = slice(0, 40)
        write_masks(own_scene, hidden)
        losses = []
        for colour in (0, 255):
            for path in (own_scene / "images").iterdir():
                image = np.array(Image.open(path))
                image[:, hidden] = colour
                Image.fromarray(image).save(path)
            trainer = make_trainer(data=own_scene, parser={"masks_path": "masks"}, **SHORT)
            trainer.pipeline.datamanager.train_unseen_cameras = [0, 1, 2, 3, 4, 5] * 5
            assert "mask" in trainer.pipeline.datamanager.cached_train[0]
            torch.manual_seed(0)
            losses.append([float(advance(trainer, 1)[0].detach()) for _ in range(24)])
        assert losses[0] == pytest.approx(losses[1], rel=1e-3)

    def test_transparent_images(self, make_trainer, own_scene):
        for path in (own_scene / "images").iterdir():
            image = np.array(Image.open(path).convert("RGBA"))
            image[:, :40, 3] = 0
            Image.fromarray(image).save(path)
        trainer = make_trainer(data=own_scene, background_color="white", **SHORT)
        model, manager = trainer.pipeline.model, trainer.pipeline.datamanager
        advance(trainer, 3)
        batch = manager.cached_train[0]
        target = model._training_targets(batch, torch.ones(3)).image
        assert target.shape == (SIZE[1] // 4, SIZE[0] // 4, 3)
        assert bool((target[:, :10] == 1).all()) and bool((target[:, 10:] < 1).any())
        advance(trainer, 22)
        metrics, images = trainer.pipeline.get_eval_image_metrics_and_images(trainer.step)
        assert bool((images["img"][:, :40] == 1).all()) and np.isfinite(metrics["psnr"])

    def test_transparent_images_follow_the_random_background(self, make_trainer, own_scene):
        for path in (own_scene / "images").iterdir():
            image = np.array(Image.open(path).convert("RGBA"))
            image[..., 3] = 128
            Image.fromarray(image).save(path)
        trainer = make_trainer(data=own_scene, **SHORT)
        model, batch = trainer.pipeline.model, trainer.pipeline.datamanager.cached_train[0]
        black, white = (model._training_targets(batch, torch.full((3,), value)).image for value in (0.0, 1.0))
        torch.testing.assert_close(white - black, torch.full_like(white, 1 - 128 / 255))
        advance(trainer, 24)
        assert all_finite(model)

    def test_the_target_is_the_image_at_the_size_of_the_stage(self, make_trainer):
        trainer = make_trainer(**SHORT)
        model = trainer.pipeline.model
        batch = trainer.pipeline.datamanager.cached_train[1]
        from nerfstudio.models.splatfacto import resize_image

        expected = resize_image(batch["image"].float() / 255, 4)
        torch.testing.assert_close(model._training_targets(batch, torch.zeros(3)).image, expected)
        assert model._training_targets(batch, torch.zeros(3)) is model._training_targets(batch, torch.ones(3))


class TestAbsurd:
    @pytest.mark.parametrize(("width", "height"), [(1, 1), (3, 3), (2, 40), (17, 5), (33, 31)])
    def test_tiny_images(self, make_trainer, tmp_path, width, height):
        from freqgs_plugin.demo.dataset import SceneOptions, write_scene

        write_scene(tmp_path / "tiny", SceneOptions(6, width, height, 40, 1), progress=False)
        trainer = make_trainer(data=tmp_path / "tiny", **SHORT)
        advance(trainer, 24)
        assert all_finite(trainer.pipeline.model)
        if min(width, height) > 1:
            # pytorch_msssim, which nerfstudio evaluates with, cannot compare single pixels
            assert np.isfinite(trainer.pipeline.get_average_eval_image_metrics()["psnr"])

    def test_two_views(self, make_trainer, tmp_path):
        from freqgs_plugin.demo.dataset import SceneOptions, write_scene

        write_scene(tmp_path / "two", SceneOptions(2, *SIZE, 40, 1), progress=False)
        trainer = make_trainer(data=tmp_path / "two", **SHORT)
        advance(trainer, 24)
        assert all_finite(trainer.pipeline.model)

    def test_one_point(self, make_trainer, scene):
        trainer = make_trainer(random_init=True, num_random=1, **SHORT)
        advance(trainer, 24)
        assert all_finite(trainer.pipeline.model) and trainer.pipeline.model.num_points >= 3

    def test_an_empty_view(self, make_trainer):
        """All Gaussians behind every camera: nothing to learn from, but no error either."""
        trainer = make_trainer(**SHORT)
        model = trainer.pipeline.model
        with torch.no_grad():
            model.gauss_params["means"] += 1e4
        before = model.num_points
        advance(trainer, 24)
        assert all_finite(model) and model.num_points >= before
