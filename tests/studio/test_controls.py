"""What the viewer's controls change, and what they must leave alone."""

import sys
import threading
from pathlib import Path

import pytest
import torch
from nerfstudio.viewer.utils import parse_object
from nerfstudio.viewer.viewer_elements import ViewerElement
from nerfstudio.viewer_legacy.server import viewer_utils
from running import advance, in_render_thread

from freqgs_plugin.functional.budget import in_view
from freqgs_plugin.studio.cameras import to_camera
from freqgs_plugin.studio.controls import (
    Stopwatch,
    budget_number,
    budget_of,
    in_viewer,
    level_cut,
    lod_slider,
    uninterrupted,
)


@pytest.fixture
def trainer(make_trainer):
    trainer = make_trainer()
    advance(trainer, 108)
    return trainer


def view(trainer):
    """The eval camera and its batch."""
    trainer.pipeline.eval()
    return trainer.pipeline.datamanager.fixed_indices_eval_dataloader[0]


def test_where_we_are():
    assert not in_viewer()
    assert in_render_thread(in_viewer)
    plain = []
    thread = threading.Thread(target=lambda: plain.append(in_viewer()))
    thread.start()
    thread.join()
    assert plain == [False]


@pytest.mark.slow
def test_the_slider_acts_in_the_viewer_alone(trainer):
    model = trainer.pipeline.model
    camera, batch = view(trainer)
    with torch.no_grad():
        before = model.get_outputs_for_camera(camera)["rgb"]
        model.controls.slider.value = 1.0
        after = model.get_outputs_for_camera(camera)
        assert torch.equal(after["rgb"], before)
        metrics, _ = model.get_image_metrics_and_images(after, batch)
        assert metrics["gaussians"] == model.num_points
        assert model.controls.drawn.value == "-"

        shown = in_render_thread(lambda: model.get_outputs_for_camera(camera)["rgb"])
        assert torch.equal(shown, after["prefix_1"])
        assert not torch.equal(shown, before)
        base, everything = model.level_counts()[0], model.num_points
        assert model.controls.drawn.value.startswith(
            f"{base:,} / {everything:,}, "
        ) and model.controls.drawn.value.endswith(" ms")

        model.controls.slider.value = 3.0
        assert torch.equal(in_render_thread(lambda: model.get_outputs_for_camera(camera)["rgb"]), before)
        assert model.controls.drawn.value.startswith(f"{everything:,} / {everything:,}, ")

        model.controls.slider.value = 2.5
        between = in_render_thread(lambda: model.get_outputs_for_camera(camera)["rgb"])
        assert not torch.equal(between, before) and not torch.equal(between, after["prefix_2"])


@pytest.mark.slow
def test_a_budget_bounds_what_the_viewer_draws(trainer):
    model = trainer.pipeline.model
    camera, _ = view(trainer)

    def drawn():
        picture = in_render_thread(lambda: model.get_outputs_for_camera(camera)["rgb"])
        return int(model.controls.drawn.value.split(" / ")[0].replace(",", "")), picture

    with torch.no_grad():
        everything, full = drawn()
        seen = int(in_view(model.gaussians(), to_camera(camera)).sum())
        model.controls.mode.value, model.controls.budget.value = "budget", 1e6
        assert drawn()[0] == seen <= everything
        torch.testing.assert_close(drawn()[1], full)
        for thousands in (0.05, 0.2):
            model.controls.budget.value = thousands
            assert drawn()[0] == round(1000 * thousands) and not torch.equal(drawn()[1], full)
        # the slider's prefix is cut down, too
        model.controls.budget.value, model.controls.slider.value = 1e6, 1.0
        base = drawn()[0]
        assert base < seen
        model.controls.budget.value = (base - 7) / 1000
        assert drawn()[0] == base - 7
        assert torch.equal(model.get_outputs_for_camera(camera)["rgb"], full)


@pytest.mark.slow
def test_training_does_not_see_the_controls(trainer):
    model = trainer.pipeline.model
    camera, _ = trainer.pipeline.datamanager.next_train(0)
    trainer.pipeline.train()
    pictures = []
    controls = model.controls
    for touched in (False, True):
        if touched:
            controls.mode.value, controls.slider.value, controls.budget.value = "budget", 1.0, 0.01
            controls.gaze.value, controls.filter.value = "middle", "xray"
        torch.manual_seed(0)
        pictures.append([p.detach() for p in model.get_outputs(camera)["prefixes"]])
    assert len(pictures[0]) == 3
    assert all(map(torch.equal, *pictures))


def test_the_viewer_finds_the_controls_without_side_effects(trainer):
    """It reads every public attribute of the model; none may raise, even where the export is refused."""
    found = parse_object(trainer.pipeline, ViewerElement, "Custom Elements")
    assert [element for _, element in found] == [trainer.pipeline.model.controls]
    assert all(path.count("/") == 2 for path, _ in found)


class Server:
    """As much of viser as an element needs."""

    def __init__(self):
        self.gui = self
        self.hooks = []
        self.value = None

    def add_text(self, name, value, *_, **__):
        self.value = value
        return self

    add_slider = add_text

    def on_update(self, hook):
        self.hooks.append(hook)


def test_writing_the_count_asks_for_no_new_picture(trainer):
    """viser calls an input's hooks when the program writes it, and nerfstudio's hook renders."""
    server = Server()
    trainer.pipeline.model.controls.drawn.install(server)
    assert server.hooks == []
    trainer.pipeline.model.controls.drawn.value = "5 / 5, 1 ms"
    assert server.value == "5 / 5, 1 ms"
    trainer.pipeline.model.controls.slider.install(server)
    assert len(server.hooks) == 1


class Interrupted(Exception):
    pass


def test_the_viewer_cannot_interrupt_what_must_be_finished():
    """As nerfstudio's SetTrace does: raise on the next line of Python, wherever that is."""
    done = []

    def interrupt(frame, event, arg):
        if event == "line" and done:
            raise Interrupted
        return interrupt

    def several_lines():
        done.append(1)
        done.append(2)
        return len(done)

    def guarded():
        with uninterrupted():
            several_lines()
            done.append(3)
        done.append(4)

    before = sys.gettrace()
    try:
        with pytest.raises(Interrupted), viewer_utils.SetTrace(interrupt):
            several_lines()
        assert done == [1]
        done.clear()
        with pytest.raises(Interrupted), viewer_utils.SetTrace(interrupt):
            guarded()
        assert done == [1, 2, 3]
    finally:
        sys.settrace(before)


def test_a_picture_that_has_begun_is_finished(trainer):
    """Abandoned while it imports the rasterizer or numba loads a kernel, the viewer stayed empty."""
    model = trainer.pipeline.model
    camera, _ = view(trainer)

    def interrupt(frame, event, arg):
        reached.add(Path(frame.f_code.co_filename).name)
        if event == "line" and any(part in frame.f_code.co_filename for part in ("freqgs_plugin/rendering", "/numba/")):
            raise Interrupted
        return interrupt

    before = sys.gettrace()
    try:
        for rasterizer in (None, model.rasterizer()):
            model._rasterizer, reached = rasterizer, set()
            with viewer_utils.SetTrace(interrupt):
                assert "rgb" in model.get_outputs_for_camera(camera)
            assert "viewing.py" in reached
    finally:
        sys.settrace(before)


def test_slider_and_cut():
    slider = lod_slider(3)
    assert (slider.min, slider.max, slider.value) == (1.0, 3.0, 3.0)
    slider.value = 1.25
    assert level_cut(slider).level == 1.25
    single = lod_slider(1)
    assert single.disabled and single.min < single.max


@pytest.mark.parametrize(
    "value, count",
    [
        (0.0, None),
        (0, None),
        (-3.0, None),
        (float("nan"), None),
        (float("inf"), None),
        (1e-9, 1),
        (0.25, 250),
        (3, 3000),
    ],
)
def test_budget(value, count):
    number = budget_number()
    assert budget_of(number) is None
    number.value = value
    assert budget_of(number) == count


def test_stopwatch():
    with Stopwatch(torch.device("cpu")) as watch:
        threading.Event().wait(0.02)
    assert 19 < watch.milliseconds < 2000
