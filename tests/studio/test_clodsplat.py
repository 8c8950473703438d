"""clodsplat under nerfstudio's own Trainer, stepped by hand."""

import itertools
import math

import numpy as np
import plyfile
import pytest
import torch
from running import SIZE, advance, in_render_thread, save
from state import all_finite, consistent, optimizer_state, parameters, same, statistics

from freqgs_plugin.functional.attenuation import TAU, DistanceDecay, normalised_distance
from freqgs_plugin.studio.optimizers import set_rate

pytestmark = pytest.mark.slow

START = 20
SHORT = {"steps_scale": 0.004, "least_refine_interval": 4, "decay_start_step": 250 * START, "method": "clodsplat"}
"""decay from step 20 on; opacities are reset every 12 steps and recover for 6"""


@pytest.fixture
def make(make_trainer):
    return lambda **settings: make_trainer(**{**SHORT, **settings})


def sigma(model):
    return model.gauss_params["decay"].detach().flatten()


def set_sigma(model, value):
    with torch.no_grad():
        model.gauss_params["decay"][:] = torch.as_tensor(value, dtype=torch.float32).expand(model.num_points)[:, None]


def view(trainer, index=0):
    trainer.pipeline.eval()
    return trainer.pipeline.datamanager.fixed_indices_eval_dataloader[index]


class TestStart:
    def test_nothing_decays_before(self, make, said):
        trainer = make()
        model = trainer.pipeline.model
        for _ in range(START):
            _, losses, metrics = advance(trainer, 1)
            assert set(losses) == {"image_1"} and "scale" not in metrics
            assert model.gaussians().decay is None and model.attenuation(3.0) is None
        assert torch.equal(sigma(model), torch.full((model.num_points,), 5.0))
        assert not trainer.optimizers.optimizers["decay"].state[model.gauss_params["decay"]]
        _, losses, metrics = advance(trainer, 1)
        assert set(losses) == {"image_1", "count"}
        assert {"scale", "drawn_share", "decay_mean", "dead_decay"} <= set(metrics)
        assert f"Step {START}: opacities decay with distance from here on." in said
        assert model.gaussians().decay is not None
        assert not torch.equal(sigma(model), torch.full((model.num_points,), 5.0))
        consistent(trainer)

    def test_until_then_it_is_the_comparison_model(self, make):
        runs = [make(), make(use_decay=False)]
        for trainer in runs:
            trainer.pipeline.datamanager.train_unseen_cameras = [0, 1, 2, 3, 4, 5] * 6
            torch.manual_seed(1)
            advance(trainer, START)
        with_decay, without = (parameters(t.pipeline.model) for t in runs)
        del with_decay["decay"]
        assert same(with_decay, without)
        advance(runs[1], 10)
        model = runs[1].pipeline.model
        assert "decay" not in model.gauss_params and model.gaussians().decay is None and model.attenuation(9.0) is None
        assert set(runs[1].optimizers.optimizers) == set(without)

    @pytest.mark.parametrize(("scale", "speedup"), [(0.004, 10.0), (0.2, 5.0), (1.0, 1.0), (3.0, 1.0)])
    def test_short_runs_learn_decays_faster(self, make, scale, speedup):
        trainer = make(steps_scale=scale)
        (group,) = trainer.optimizers.optimizers["decay"].param_groups
        assert group["lr"] == pytest.approx(1e-2 * speedup)
        advance(trainer, 3)
        resumed = make(steps_scale=scale, load_dir=save(trainer))
        (again,) = resumed.optimizers.optimizers["decay"].param_groups
        assert again["lr"] == trainer.optimizers.optimizers["decay"].param_groups[0]["lr"] < group["lr"] + 1e-9
        assert resumed.optimizers.optimizers["means"].param_groups[0]["lr"] <= 1.6e-4

    def test_the_scene_distance_is_measured(self, make):
        trainer = make()
        model = trainer.pipeline.model
        advance(trainer, START)
        gaussians = model.gaussians()
        largest = []
        for camera in model._train_cameras():
            distance = (gaussians.means - camera.centre).norm(dim=1)
            reference = distance / normalised_distance(gaussians, camera, "frustum_max")
            largest.append(float(reference.median()))
        advance(trainer, 1)
        assert model.scene_distance == pytest.approx(np.median(largest), rel=1e-5)
        assert model.attenuation(2.0) == DistanceDecay(2.0, "scene", model.scene_distance, soft=True)


class TestSteps:
    def test_scales_are_drawn_and_held_after_resets(self, make):
        trainer = make(full_detail_every=0)
        model = trainer.pipeline.model
        scales = {}
        for step in range(START + 60):
            metrics = advance(trainer, 1)[2]
            if step >= START:
                scales[step] = metrics["scale"]
        resets = [step for step in scales if model.schedule.resets(step)]
        assert len(resets) >= 3
        held = {step for reset in resets for step in range(reset + 1, reset + 1 + model.schedule.reset_pause)}
        assert all(scales[step] == 1 for step in held & scales.keys())
        free = [scale for step, scale in scales.items() if not model.schedule.recovers(step)]
        assert len(free) > 10 and min(free) > 1 and max(free) <= model.config.largest_scale

    def test_every_row_stays_and_the_hidden_are_not_seen(self, make):
        trainer = make(full_detail_every=0)
        model = trainer.pipeline.model
        advance(trainer, START + 1)
        hidden = torch.zeros(model.num_points, dtype=torch.bool)
        hidden[::3] = True
        set_sigma(model, torch.where(hidden, 0.05, 50.0))
        seen = {}
        observe = model.strategy.observe

        def spy(state, info, weight):
            seen.update(info, weight=weight)
            observe(state, info, weight)

        model.strategy.observe = spy
        for group in model.strategy_state:
            if torch.is_tensor(model.strategy_state[group]):
                model.strategy_state[group].zero_()
        advance(trainer, 1)
        assert seen["radii"].shape == (1, len(hidden)) and seen["means2d"].shape == (1, len(hidden), 2)
        assert bool((seen["radii"][0][hidden] == 0).all()) and bool((seen["radii"][0][~hidden] > 0).any())
        assert seen["drawn"] == int((seen["margin"] > 0).sum())
        assert bool((model.strategy_state["count"][hidden] == 0).all())
        assert bool((seen["means2d"].absgrad[0][hidden] == 0).all())

    def test_densification_does_not_see_the_weight_of_the_loss(self, make):
        """Twice the same step, with and without w_s: the statistics agree, the loss does not."""
        found = {}
        for weigh in (True, False):
            # the same way to the compared step, to the last bit; that refines nothing, as it would prune after it
            trainer = make(weigh_scales=False, reg_weight=0.0, full_detail_every=0)
            trainer.pipeline.datamanager.train_unseen_cameras = [0, 1, 2, 3, 4, 5] * 6
            torch.manual_seed(1)
            advance(trainer, START + 1)
            trainer.pipeline.model.config.weigh_scales = weigh
            state = trainer.pipeline.model.strategy_state
            for key in ("grad2d", "count", "radii"):
                state[key].zero_()
            _, losses, metrics = advance(trainer, 1)
            found[weigh] = (float(losses["image_1"].detach()), state["grad2d"].clone(), metrics["scale"])
        w = (1 - 0.5 * found[True][2] / trainer.pipeline.model.config.largest_scale) ** 2
        assert found[True][0] == pytest.approx(w * found[False][0], rel=1e-4) and w < 0.82
        torch.testing.assert_close(found[True][1], found[False][1], rtol=1e-3, atol=1e-9)

    def test_nothing_to_draw_at_this_scale_draws_at_1(self, make):
        trainer = make(full_detail_every=0)
        model = trainer.pipeline.model
        advance(trainer, START + 1)
        while model.schedule.recovers(model.step + 1):
            advance(trainer, 1)
        set_sigma(model, 50.0)
        with torch.no_grad():
            model.gauss_params["opacities"][:] = math.log(1.02 * TAU / (1 - 1.02 * TAU))
        _, losses, metrics = advance(trainer, 1)
        assert metrics["scale"] == 1.0 and metrics["drawn_share"] > 0 and float(losses["count"]) == 0

    @pytest.mark.parametrize("dead_decay", ["prune", "keep"])
    def test_all_dead(self, make, dead_decay):
        """Defined, finite, and over at the next refinement."""
        trainer = make(dead_decay=dead_decay)
        model = trainer.pipeline.model
        advance(trainer, START + 1)
        set_sigma(model, -1.0)
        camera, batch = view(trainer)
        outputs = model.get_outputs_for_camera(camera)
        assert torch.equal(outputs["rgb"], outputs["background"])
        assert torch.equal(outputs["detail_5"], outputs["background"])
        metrics, _ = model.get_image_metrics_and_images(outputs, batch)
        assert metrics["gaussians_detail_1"] == 0 and np.isfinite(metrics["psnr_detail_5"])
        total = advance(trainer, 1)[0]
        assert bool(torch.isfinite(total))
        advance(trainer, 9)
        consistent(trainer)
        assert all_finite(model) and model.guard.skipped == 0
        assert model.num_points == 1 if dead_decay == "prune" else float(sigma(model).min()) >= 0.25


class TestDensification:
    def test_children_inherit_their_decay(self, make):
        trainer = make(densify_grad_thresh=1e-6, reset_alpha_every=1000, least_weight=0.0, least_views=0)
        model = trainer.pipeline.model
        advance(trainer, START + 1)
        with torch.no_grad():
            # the colour says which decay a Gaussian has
            model.gauss_params["decay"][:] = 3 + torch.rand(model.num_points, 1)
            model.gauss_params["features_dc"][:] = model.gauss_params["decay"] * 10
            model.gauss_params["opacities"][::7] = -10.0
        for name in ("features_dc", "decay"):
            set_rate(trainer.optimizers, name, 0.0)
        counts = {model.num_points}
        for _ in range(12):
            advance(trainer, 1)
            consistent(trainer)
            decay, colour = (model.gauss_params[name].detach() for name in ("decay", "features_dc"))
            torch.testing.assert_close(colour, decay.expand_as(colour) * 10)
            counts.add(model.num_points)
        assert len(counts) > 2

    def test_the_dead_are_removed_and_counted(self, make, said):
        trainer = make(densify_grad_thresh=1e6, reset_alpha_every=1000, dead_decay="prune")
        model = trainer.pipeline.model
        advance(trainer, START + 1)
        with torch.no_grad():
            model.gauss_params["decay"][:30] = -1.0
            model.gauss_params["opacities"][:] = 3.0
        rest = parameters(model)["features_dc"][30:]
        set_rate(trainer.optimizers, "features_dc", 0.0)
        camera, batch = view(trainer)
        metrics, _ = model.get_image_metrics_and_images(model.get_outputs_for_camera(camera), batch)
        assert metrics["dead_decay"] == 30
        while not any("dead decay" in line for line in said):
            advance(trainer, 1)
        (line,) = [line for line in said if "dead decay" in line]
        assert "30 removed (dead decay)" in line
        assert torch.equal(model.gauss_params["features_dc"].detach(), rest)
        consistent(trainer)

    def test_those_dark_in_every_view_go_before_a_reset(self, make, said):
        trainer = make(densify_grad_thresh=1e6, least_weight=0.0, least_views=0, dead_decay="prune")
        model = trainer.pipeline.model
        advance(trainer, START + 1)
        with torch.no_grad():
            model.gauss_params["decay"][:30] = 1e-3
            model.gauss_params["opacities"][:] = 3.0
        set_rate(trainer.optimizers, "decay", 0.0)
        while not model.schedule.looks_at_views(model.step):
            assert not any("dead decay" in line for line in said)
            advance(trainer, 1)
        assert any("30 removed (dead decay)" in line for line in said)

    def test_the_dead_are_kept_alive_if_asked(self, make, said):
        trainer = make(dead_decay="keep", least_decay=0.4)
        model = trainer.pipeline.model
        advance(trainer, START + 1)
        with torch.no_grad():
            model.gauss_params["decay"][:30] = -1.0
        advance(trainer, 1)
        assert float(sigma(model).min()) == pytest.approx(0.4)
        assert model.num_dead >= 30
        advance(trainer, 8)
        assert any("held (dead decay)" in line for line in said)


class TestCheckpoints:
    @pytest.mark.parametrize("steps", [3, START, START + 1, START + 5, START + 30])
    def test_a_resumed_run_is_the_same_run(self, make, steps):
        """Before and after the start, held after a reset or not: bit-exact, and so are the next steps."""
        settings = {"camera_optimizer": "SO3xR3"}
        first = make(**settings)
        advance(first, steps)
        second = make(load_dir=save(first), **settings)
        a, b = first.pipeline.model, second.pipeline.model
        assert second._start_step == steps
        consistent(second)

        def compare():
            assert same(parameters(a), parameters(b))
            assert same(optimizer_state(first), optimizer_state(second))
            assert same(statistics(a), statistics(b))
            assert (a._decays, a.scene_distance, a.schedule) == (b._decays, b.scene_distance, b.schedule)

        compare()
        scales = []
        for trainer in (first, second):
            trainer.pipeline.datamanager.train_unseen_cameras = [0, 1, 2, 3, 4, 5] * 3
            torch.manual_seed(1)
            scales.append([advance(trainer, 1)[2].get("scale") for _ in range(8)])
        assert scales[0] == scales[1]
        compare()

    @pytest.mark.parametrize("steps", [5, START + 5])
    def test_pictures_survive(self, make, steps):
        first = make()
        advance(first, steps)
        second = make(load_dir=save(first))
        pictures = [dict(t.pipeline.model.get_outputs_for_camera(view(t, 1)[0])) for t in (first, second)]
        assert same(*pictures)

    def test_loads_with_tensors_only(self, make):
        trainer = make()
        advance(trainer, START + 5)
        (file,) = save(trainer).glob("*.ckpt")
        state = torch.load(file, map_location="cpu", weights_only=True)["pipeline"]
        assert state["_model.gauss_params.decay"].shape == (trainer.pipeline.model.num_points, 1)
        assert state["_model._extra_state"]["decays"] is True

    @pytest.mark.parametrize("made_by", [{"method": "lapsplat"}, {"method": "clodsplat", "use_decay": False}])
    def test_checkpoints_without_decay_are_refused(self, make, make_trainer, made_by):
        other = make_trainer(**made_by)
        advance(other, 2)
        with pytest.raises(ValueError, match=r"holds the parameters features_dc.*this model has decay, features_dc"):
            make(load_dir=save(other))


ABLATIONS = {
    "no weight": {"weigh_scales": False},
    "no count": {"reg_weight": 0.0},
    "paper": {"reg_gradient": "none"},
    "soft": {"reg_gradient": "soft"},
    "only full detail": {"largest_scale": 1.0},
    "far": {"largest_scale": 1e4},
    "full detail by chance": {"full_detail_every": 0},
    "uncompensated": {"densify_compensate": False},
    "quantile": {"train_reference": "frustum_quantile", "view_reference": "frustum_quantile"},
    "scene": {"train_reference": "scene"},
    "frustum": {"view_reference": "frustum_max"},
    "hard cut": {"soft_cut": False},
    "soft cut in training": {"train_soft_cut": True},
    "pruned": {"dead_decay": "prune"},
    "opacities learn too": {"reg_opacities": True},
    "narrow sigmoids": {"reg_temperature": 0.1},
    "from the start": {"decay_start_step": 0},
    "tiny decay": {"initial_decay": 1e-3},
    "huge decay": {"initial_decay": 1e8},
    "drops": {"least_weight": 1.0},
    "keeps": {"least_weight": 0.0, "least_views": 0},
    "classic": {"rasterize_mode": "classic"},
    "torch": {"rasterizer": "torch"},
    "no absgrad": {"use_absgrad": False},
    "camera poses": {"camera_optimizer": "SO3xR3"},
    "bilateral grid": {"use_bilateral_grid": True},
    "scale regularization": {"use_scale_regularization": True},
    "hard clamp": {"clamp_in_loss": "hard"},
    "random points": {"random_init": True, "num_random": 50},
    "one point": {"random_init": True, "num_random": 1},
}


@pytest.mark.parametrize("name", ABLATIONS)
def test_switches(make, name):
    settings = ABLATIONS[name]
    trainer = make(**settings)
    model = trainer.pipeline.model
    total, losses, _ = advance(trainer, START + 16)
    consistent(trainer)
    assert bool(torch.isfinite(total)) and all_finite(model) and model.guard.skipped == 0
    assert ("count" in losses) == (settings.get("reg_weight") != 0)
    means = trainer.pipeline.get_average_eval_image_metrics()
    assert all(np.isfinite(value) for value in means.values())


def test_half_precision_is_kept_out_of_the_decay(make):
    trainer = make()
    model = trainer.pipeline.model
    advance(trainer, START + 1)
    camera, _ = view(trainer)
    expected = model.get_outputs_for_camera(camera)["detail_3"]
    with torch.autocast("cpu", torch.bfloat16):
        gaussians = model.gaussians()
        weight = model.attenuation(3.0)(gaussians, next(model._train_cameras()))
    assert weight.dtype == torch.float32
    assert bool(expected.isfinite().all())


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"largest_scale": 0.5}, "largest_scale is 0.5; it must be a finite number >= 1"),
        ({"initial_decay": 0.0}, "initial_decay is 0.0; it must be a finite number > 0"),
        ({"least_decay": 0.0}, "least_decay is 0.0"),
        ({"least_decay": math.inf}, "least_decay is inf"),
        ({"detail_scales": (1.0, 0.0)}, r"detail_scales are \(1.0, 0.0\); each must be a finite number > 0"),
        ({"detail_scales": (1.0, math.inf)}, "detail_scales are"),
        ({"reg_temperature": math.nan}, "reg_temperature is nan"),
        ({"reg_temperature": 0.0}, "reg_temperature is 0.0"),
        ({"reg_weight": -5.0}, "reg_weight is -5.0"),
        ({"export_distance": math.nan}, "export_distance is nan"),
        ({"decay_start_step": -5}, "decay_start_step is -5"),
        ({"full_detail_every": -1}, "full_detail_every is -1"),
        ({"strategy": "mcmc"}, r"'mcmc' does not work with clodsplat: MCMC moves"),
    ],
)
def test_settings_that_cannot_be(make, settings, message):
    with pytest.raises(ValueError, match=message):
        make(**settings)


class TestPictures:
    @pytest.fixture
    def trainer(self, make):
        """Decays from 0.1 to 20, so that every scale hides others."""
        trainer = make()
        advance(trainer, START + 1)
        model = trainer.pipeline.model
        set_sigma(model, torch.logspace(-1, 1.3, model.num_points))
        return trainer

    def test_outputs(self, trainer):
        camera, batch = view(trainer)
        model = trainer.pipeline.model
        outputs = model.get_outputs_for_camera(camera)
        details = [f"detail_{s}" for s in ("1", "1.5", "2", "3", "5", "7")]
        assert list(outputs) == ["rgb", "depth", "accumulation", "background", *details, "drawn_share", "decay"]
        for name, value in outputs.items():
            assert value.shape == (SIZE[1], SIZE[0], 1 if name in ("depth", "accumulation", "drawn_share") else 3), name
            assert bool(value.isfinite().all()) and float(value.min()) >= 0, name
            assert name == "depth" or float(value.max()) <= 1, name
        assert torch.equal(outputs["detail_1"], outputs["rgb"])
        assert len({float(outputs[name].sum()) for name in details}) == len(details)
        metrics, _ = model.get_image_metrics_and_images(outputs, batch)
        counts = [metrics[f"gaussians_{name}"] for name in details]
        assert counts == sorted(counts, reverse=True) and len(set(counts)) == len(details)
        assert counts[0] < metrics["gaussians"] == model.num_points
        assert metrics["psnr_detail_1"] == pytest.approx(metrics["psnr"], abs=1e-4)
        assert all(metrics[f"milliseconds_{name}"] > 0 for name in details)
        share = outputs["drawn_share"][outputs["accumulation"] > 0.5]
        assert 0 < float(share.mean()) < 1

    def test_counts_are_those_of_the_formula(self, trainer):
        model = trainer.pipeline.model
        camera, batch = view(trainer)
        metrics, _ = model.get_image_metrics_and_images(model.get_outputs_for_camera(camera), batch)
        opacity = torch.sigmoid(model.gauss_params["opacities"].detach()).flatten().double()
        centre = camera.camera_to_worlds[0, :3, 3].double()
        distance = (model.means.detach().double() - centre).norm(dim=1) / model.scene_distance
        for scale in (1.0, 2.0, 5.0):
            faded = opacity * torch.exp(-((distance * scale) ** 2) / (2 * sigma(model).double() ** 2 + 1e-8))
            assert metrics[f"gaussians_detail_{scale:g}"] == pytest.approx(int((faded > scale / 255).sum()), abs=2)

    def test_the_slider_acts_in_the_viewer_alone(self, trainer):
        model = trainer.pipeline.model
        camera, _ = view(trainer)

        def shown():
            return in_render_thread(lambda: dict(model.get_outputs_for_camera(camera)))

        before = model.get_outputs_for_camera(camera)
        model.controls.slider.value = 3.0
        after = model.get_outputs_for_camera(camera)
        assert torch.equal(before["rgb"], after["rgb"]) and model.controls.drawn.value == "-"
        seen = shown()
        assert torch.equal(seen["rgb"], before["detail_3"])
        drawn = int(model.controls.drawn.value.split(" / ")[0].replace(",", ""))
        assert 0 < drawn < model.num_points
        assert not torch.equal(seen["drawn_share"], before["drawn_share"])
        model.controls.slider.value = 1.0
        full = shown()
        assert torch.equal(full["rgb"], before["rgb"])
        assert float((full["drawn_share"] - 1).abs()[full["accumulation"] > 0.5].max()) < 1e-3
        model.controls.slider.value = 10.0
        assert torch.equal(shown()["detail_2"], before["detail_2"])
        model.controls.mode.value = "all"
        assert torch.equal(shown()["rgb"], before["rgb"])

    def test_the_view_does_not_pop(self, trainer):
        """A hundredth more scale changes the picture by as little everywhere, although Gaussians vanish."""
        model = trainer.pipeline.model
        camera, _ = view(trainer)
        from freqgs_plugin.studio.cameras import to_camera

        black, gaussians, ours = torch.zeros(3), model.gaussians(), to_camera(camera)
        with torch.no_grad():
            pictures, counts = [], []
            for scale in np.arange(1.5, 2.5, 0.02):
                rendering = model.draw(gaussians, ours, black, model.attenuation(float(scale)))
                pictures.append(rendering.features)
                counts.append(rendering.info["drawn"])
        steps = torch.stack([(b - a).abs().max() for a, b in itertools.pairwise(pictures)])
        assert counts[0] > counts[-1]
        assert float(steps.max()) < 0.05


class TestExport:
    def export(self, trainer, folder):
        import tyro
        from nerfstudio.scripts.exporter import Commands

        save(trainer)
        config = trainer.config.get_base_dir() / "config.yml"
        arguments = ["gaussian-splat", "--load-config", str(config), "--output-dir", str(folder)]
        tyro.cli(Commands, args=arguments).main()
        return plyfile.PlyData.read(folder / "splat.ply")["vertex"].data

    def test_opacities_of_the_chosen_distance(self, make, tmp_path, said):
        trainer = make(export_distance=0.7)
        model = trainer.pipeline.model
        advance(trainer, START + 1)
        set_sigma(model, torch.logspace(-1.5, 1.5, model.num_points))
        opacity = torch.sigmoid(model.gauss_params["opacities"].detach()).flatten()
        faded = opacity * torch.exp(-(0.7**2) / (2 * sigma(model) ** 2))
        kept = faded > TAU
        rows = self.export(trainer, tmp_path)
        assert len(rows) == int(kept.sum()) < model.num_points
        expected = torch.logit(faded.double())[kept].numpy()
        np.testing.assert_allclose(rows["opacity"], expected, rtol=1e-4, atol=1e-4)
        assert np.array_equal(rows["x"], model.means.detach()[kept, 0].numpy())
        assert any("opacities are those seen from 0.7 of the scene's distance" in line for line in said)

    @pytest.mark.parametrize("settings", [{"use_decay": False}, {}])
    def test_without_decay_as_it_is(self, make, tmp_path, said, settings):
        trainer = make(**settings)
        advance(trainer, 5)
        rows = self.export(trainer, tmp_path)
        opacities = trainer.pipeline.model.gauss_params["opacities"].detach().flatten()
        assert np.array_equal(rows["opacity"], opacities[opacities >= -5.5373].numpy())
        assert not any("seen from" in line for line in said)

    def test_extreme_decays_export_finite_logits(self, make):
        trainer = make()
        model = trainer.pipeline.model
        advance(trainer, START + 1)
        extremes = torch.tensor([-1.0, 0.0, 1e-8, 1e-3, 1.0, 1e8])
        set_sigma(model, extremes[torch.arange(model.num_points) % 6])
        with torch.no_grad():
            model.gauss_params["opacities"][::2] = 40.0
            model.gauss_params["opacities"][1::4] = -40.0
        logits = model.opacities
        assert logits.shape == (model.num_points, 1) and bool(logits.isfinite().all())
        assert bool((logits[sigma(model) <= 0] < -50).all())
