"""The viewer's modes, gaze, filters and focus on a trained run, without a browser."""

import threading
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from nerfstudio.viewer.viewer_elements import ViewerDropdown
from running import SIZE, in_render_thread

from freqgs_plugin.apps.filters import apply_filter
from freqgs_plugin.apps.focus import Focus, Selection, vote_in_folder
from freqgs_plugin.apps.foveation import Foveation
from freqgs_plugin.apps.gaze import salient_point
from freqgs_plugin.apps.geometry import GeometryIndex
from freqgs_plugin.apps.region import Ball
from freqgs_plugin.functional.attenuation import LevelCut, Product
from freqgs_plugin.functional.budget import in_view
from freqgs_plugin.io.images import write_image
from freqgs_plugin.studio.checkpoint import load_run
from freqgs_plugin.studio.clicking import Clicks, sight
from freqgs_plugin.studio.controls import detail_slider, lod_slider
from freqgs_plugin.studio.filtering import FilterCache
from freqgs_plugin.studio.masking import Surroundings
from freqgs_plugin.studio.panel import Panel
from freqgs_plugin.studio.viewing import SMALL, show
from freqgs_plugin.types import Camera, Gaussians

pytestmark = pytest.mark.slow
NOTHING = Gaussians(
    *(torch.zeros(0, k) for k in (3, 4, 3)),
    torch.zeros(0),
    torch.zeros(0, 3),
    torch.zeros(0, 0, 3),
    torch.zeros(0, dtype=torch.int32),
)


@pytest.fixture(scope="module")
def loaded(trained):
    run = load_run(trained)
    run.model.eval()
    return run


@pytest.fixture
def run(loaded):
    """The run with controls that nobody has touched."""
    loaded.model.controls = loaded.model._make_controls()
    return loaded


def choose(run, **values):
    for name, value in values.items():
        getattr(run.model.controls, name).value = value


def shown(run, client=None):
    """The viewer's outputs for the first held-out view, in a render thread of `client`."""

    def work():
        threading.current_thread().client = None if client is None else SimpleNamespace(client_id=client)
        return run.model._view_outputs(run.cameras("test")[0].camera, run.background)

    return in_render_thread(work)


def count(run):
    return int(run.model.controls.drawn.value.split(" / ")[0].replace(",", ""))


def drawn(run, attenuation=None, gaussians=None):
    camera = run.cameras("test")[0].camera
    gaussians = run.gaussians if gaussians is None else gaussians
    return show(run.model.draw(gaussians, camera, run.background, attenuation).features)


def test_modes_of_levels(run):
    full = shown(run)["rgb"]
    assert torch.equal(full, drawn(run))
    choose(run, slider=1.0)
    base = shown(run)["rgb"]
    assert torch.equal(base, drawn(run, LevelCut(1))) and not torch.equal(base, full)
    choose(run, mode="all")
    assert torch.equal(shown(run)["rgb"], full)
    choose(run, mode="band")
    assert torch.equal(shown(run)["rgb"], base), "the band of level 1 is level 1"
    for value, level in ((1.5, 2), (2.0, 2), (2.45, 2), (2.5, 3), (3.0, 3)):
        choose(run, slider=value)
        outputs = shown(run)
        torch.testing.assert_close(outputs["rgb"], outputs[f"band_{level}"])
        assert count(run) == int((run.gaussians.level <= level).sum())


def test_a_budget_acts_in_its_mode_alone(run):
    full = shown(run)["rgb"]
    choose(run, budget=0.05)
    assert torch.equal(shown(run)["rgb"], full)
    choose(run, mode="budget")
    assert not torch.equal(shown(run)["rgb"], full) and count(run) == 50


@pytest.mark.parametrize("bad", [-3.0, float("nan"), float("inf")])
def test_a_bad_budget_is_told_and_the_last_one_stays(run, bad):
    choose(run, mode="budget", budget=bad)
    full = shown(run)["rgb"]
    assert torch.equal(full, drawn(run))
    assert run.model.controls.note.value == (
        f"The budget is {bad:g}; it must be 0 (no bound) or more. The last stays: no bound."
    )
    choose(run, budget=0.05)
    some = shown(run)["rgb"]
    choose(run, budget=bad)
    assert torch.equal(shown(run)["rgb"], some) and "The last stays: 50 Gaussians." in run.model.controls.note.value
    choose(run, mode="prefix")
    shown(run)
    assert run.model.controls.note.value == ""


def test_a_budget_below_level_1_is_told(run):
    seen = in_view(run.gaussians, run.cameras("test")[0].camera)
    base = int((seen & (run.gaussians.level == 1)).sum())
    choose(run, mode="budget", budget=(base - 1) / 1000)
    shown(run)
    assert run.model.controls.note.value == (
        f"The budget of {base - 1:,} is below level 1, of which {base:,} are in view: it is drawn in part."
    )
    choose(run, budget=base / 1000)
    shown(run)
    assert run.model.controls.note.value == "" and count(run) == base


def test_a_gaze_is_kept_for_each_client(run):
    full = shown(run)["rgb"]
    choose(run, gaze="click")
    assert torch.equal(shown(run, client=1)["rgb"], full), "nobody has clicked"
    run.model.controls.look(1, (0.2, 0.3))
    run.model.controls.look(2, (0.9, 0.9))
    for client, gaze in ((1, (0.2, 0.3)), (2, (0.9, 0.9)), (1, (0.2, 0.3))):
        expected = drawn(run, Product((LevelCut(3), Foveation(gaze))))
        assert torch.equal(shown(run, client)["rgb"], expected) and not torch.equal(expected, full)
    assert torch.equal(shown(run, client=3)["rgb"], full)
    choose(run, gaze_radius=0.4)
    assert torch.equal(shown(run, 1)["rgb"], drawn(run, Foveation((0.2, 0.3), radius=0.4)))
    choose(run, gaze="middle")
    assert torch.equal(shown(run, 1)["rgb"], drawn(run, Foveation((0.5, 0.5), radius=0.4)))
    choose(run, gaze="off")
    assert torch.equal(shown(run, 1)["rgb"], full)


def test_a_gaze_outside_of_the_picture_is_told_and_the_last_one_stays(run):
    choose(run, gaze="click")
    run.model.controls.look(1, (0.2, 0.3))
    before = shown(run, 1)["rgb"]
    for bad in ((1.25, 0.5), (0.5, -0.01), (float("nan"), 0.5)):
        run.model.controls.look(1, bad)
        assert "lies outside of the picture, and the last one stays." in run.model.controls.note.value
        assert torch.equal(shown(run, 1)["rgb"], before)
    run.model.controls.look(1, (0.0, 1.0))
    assert run.model.controls.note.value == "" and not torch.equal(shown(run, 1)["rgb"], before)


@pytest.mark.parametrize("name", ["xray", "brush", "sharp"])
def test_a_filter_changes_every_picture_of_the_viewer(run, name):
    plain = shown(run)
    choose(run, filter=name)
    outputs = shown(run)
    assert torch.equal(outputs["rgb"], drawn(run, gaussians=apply_filter(run.gaussians, name)))
    assert not torch.equal(outputs["prefix_3"], plain["prefix_3"])
    choose(run, filter="off")
    assert torch.equal(shown(run)["rgb"], plain["rgb"])


def test_a_filter_of_one_level_is_refused(run, monkeypatch):
    monkeypatch.setitem(run.model._buffers, "level", torch.ones_like(run.model.level))
    choose(run, filter="xray")
    assert torch.isfinite(shown(run)["rgb"]).all()
    assert run.model.controls.note.value.startswith("Not filtered: filter 'xray' works by level")
    choose(run, filter="off")
    shown(run)
    assert run.model.controls.note.value == ""


def test_filtered_scenes_are_made_anew_only_when_something_has_changed(run):
    parameters = [torch.nn.Parameter(torch.ones(3)), torch.zeros(2)]
    made = []

    def scene():
        made.append(1)
        return run.gaussians

    cache = FilterCache()
    first = cache.get("xray", scene, parameters, 3)
    assert cache.get("xray", scene, parameters, 3) is first and len(made) == 1
    cache.get("brush", scene, parameters, 3)
    cache.get("brush", scene, parameters, 2)
    assert len(made) == 3
    with torch.no_grad():
        parameters[0].add_(1.0)
    cache.get("brush", scene, parameters, 2)
    parameters[1] = torch.zeros(2)
    again = cache.get("brush", scene, parameters, 2)
    assert len(made) == 5 and cache.get("brush", scene, parameters, 2) is again
    parameters[0].data = torch.ones(3)
    cache.get("brush", scene, parameters, 2)
    cache.get("brush", scene, parameters[:1], 2)
    cache.clear()
    cache.get("brush", scene, parameters[:1], 2)
    assert len(made) == 8


def click_of(run, share=(0.5, 0.5)):
    """Origin and direction of the ray through a place of the first held-out view."""
    camera = run.cameras("test")[0].camera
    x, y = share[0] * camera.width, share[1] * camera.height
    ray = torch.stack([(x - camera.K[0, 2]) / camera.K[0, 0], (y - camera.K[1, 2]) / camera.K[1, 1], torch.tensor(1.0)])
    return tuple(camera.centre.tolist()), tuple((camera.viewmat[:3, :3].T @ ray).tolist())


def test_a_focus_is_where_a_client_has_clicked(run):
    full = shown(run)["rgb"]
    choose(run, focus="click", focus_radius=0.1)
    assert torch.equal(shown(run, 1)["rgb"], full), "nobody has clicked"
    camera, share = run.cameras("test")[0].camera, (0.5, 0.6)
    run.model.controls.point(1, *click_of(run, share))
    picture = shown(run, 1)["rgb"]
    hit = GeometryIndex(run.gaussians).pick(camera, (share[0] * camera.width, share[1] * camera.height))
    radius = 0.1 * float((hit.point - camera.centre).norm())
    expected = drawn(run, Ball(tuple(hit.point.tolist()), radius))
    torch.testing.assert_close(picture, expected)
    assert int((run.gaussians.level == 1).sum()) < count(run) < len(run.gaussians)
    assert torch.equal(shown(run, 2)["rgb"], full), "another client has not clicked"
    fewer = count_with(run, focus_radius=0.02)
    assert fewer < count_with(run, focus_radius=0.5)


def count_with(run, **values):
    choose(run, **values)
    shown(run, 1)
    return count(run)


def test_a_click_at_nothing_is_told_and_the_last_focus_stays(run):
    choose(run, focus="click")
    run.model.controls.point(1, *click_of(run))
    before = shown(run, 1)["rgb"]
    origin, direction = click_of(run)
    run.model.controls.point(1, (1e3, 1e3, 1e3), (1.0, 1.0, 1.0))
    assert torch.equal(shown(run, 1)["rgb"], before)
    assert run.model.controls.note.value == "Under the click is nothing of level 1, and the last focus stays."
    run.model.crop_box = SimpleNamespace(within=lambda means: torch.zeros(len(means), 1, dtype=torch.bool))
    try:
        run.model.controls.point(1, origin, direction)
        shown(run, 1)
    finally:
        run.model.crop_box = None
    assert run.model.controls.note.value.startswith("Nothing can be picked: level is 1, and no Gaussian is of that")
    run.model.controls.point(1, origin, direction)
    assert torch.equal(shown(run, 1)["rgb"], before) and run.model.controls.note.value == ""


def mask_folder(run, folder, size=SIZE, box=((20, 50), (20, 60))):
    folder.mkdir()
    (top, bottom), (left, right) = box
    for view in run.cameras("test"):
        mask = np.zeros((size[1], size[0]), np.uint8)
        mask[top:bottom, left:right] = 255
        write_image(folder / f"{view.name.rsplit('.', 1)[0]}.png", np.repeat(mask[..., None], 3, -1))
    return folder


def search(run, folder):
    """Name a folder and press the button; what is said at once, and in the end."""
    panel = run.model.controls
    panel.masked.folder.value = str(folder)
    panel.masked.ask()
    shown(run)
    first = panel.note.value
    join_searches()
    return first, panel.note.value


def test_a_focus_by_a_folder_of_masks(run, tmp_path):
    choose(run, focus="masks")
    full = shown(run)["rgb"]
    assert torch.equal(full, drawn(run)), "no folder is named"
    folder = mask_folder(run, tmp_path / "masks")
    views = [*run.cameras("train"), *run.cameras("test")]
    look = {"rasterizer": run.rasterizer, "antialiased": run.antialiased}
    expected = vote_in_folder(run.gaussians, [v.name for v in views], [v.camera for v in views], folder, **look)
    first, last = search(run, folder)
    assert first == f"Looking for the object that the masks in {folder} mark ..."
    assert last == f"The object has {expected.count:,} Gaussians."
    picture = shown(run)["rgb"]
    assert torch.equal(picture, drawn(run, Focus(expected.rows))) and not torch.equal(picture, full)

    bad = {
        "": "No folder of masks is named",
        str(tmp_path / "nowhere"): "nowhere is no folder",
        str(mask_folder(run, tmp_path / "small", (40, 32))): "is 40x32 px, and its view 80x64 px",
        str(mask_folder(run, tmp_path / "empty", box=((0, 0), (0, 0)))): "are empty",
        str(mask_folder(run, tmp_path / "dot", box=((0, 1), (0, 1)))): "of none of the",
    }
    for name, message in bad.items():
        said = search(run, name)[1]
        assert message in said and said.endswith("The last object stays."), said
        assert torch.equal(shown(run)["rgb"], picture), "the last good state"
    choose(run, filter="sharp")
    shown(run)
    assert "The object was found among" in run.model.controls.note.value
    choose(run, filter="off", focus="off")
    assert torch.equal(shown(run)["rgb"], full) and run.model.controls.note.value == ""


def test_while_masks_are_searched_the_viewer_draws_and_the_newest_search_counts(run, monkeypatch):
    go, names = threading.Event(), iter(["slow", "quick"])
    rows = {name: torch.arange(len(run.gaussians)) % 2 == i for i, name in enumerate(("slow", "quick"))}

    def find(gaussians, *_, **__):
        name = next(names)
        if name == "slow":
            assert go.wait(60)
        return Selection(rows[name], rows[name].float(), rows[name].float())

    monkeypatch.setattr("freqgs_plugin.studio.masking.vote_in_folder", find)
    choose(run, focus="masks")
    panel = run.model.controls
    panel.masked.folder.value = "a"
    panel.masked.ask()
    full = shown(run)["rgb"]
    assert torch.equal(full, drawn(run)) and panel.note.value.startswith("Looking for")
    assert "The object has" in search_again(run, "b")
    go.set()
    join_searches()
    assert torch.equal(shown(run)["rgb"], drawn(run, Focus(rows["quick"])))


def join_searches(but=0):
    searches = [thread for thread in threading.enumerate() if "_find" in thread.name]
    for thread in searches[but:]:
        thread.join(60)


def search_again(run, folder):
    run.model.controls.masked.folder.value = folder
    run.model.controls.masked.ask()
    shown(run)
    join_searches(but=1)
    return run.model.controls.note.value


def test_the_gaze_goes_to_what_stands_out(run):
    choose(run, gaze="salient")
    picture = shown(run)["rgb"]
    base = drawn(run, LevelCut(1))
    camera = run.cameras("test")[0].camera
    factor = SMALL / max(camera.width, camera.height)
    K = camera.K.clone()
    K[:2] *= factor
    large = Camera(camera.viewmat, K, round(camera.width * factor), round(camera.height * factor))
    small = show(run.model.draw(run.gaussians, large, run.background, LevelCut(1)).features)
    gaze = salient_point(small.detach().numpy())
    assert torch.equal(picture, drawn(run, Foveation(gaze))) and not torch.equal(picture, base)


@pytest.mark.parametrize("direction", [(0.0, 0.0, 1.0), (0.3, -2.0, 0.1), (-5.0, 0.0, 0.0)])
def test_a_sight_looks_along_the_ray(direction):
    origin = torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
    along = torch.tensor(direction, dtype=torch.float64)
    camera = sight(tuple(origin.tolist()), direction, torch.zeros(1, 3))
    point = camera.viewmat @ torch.cat([origin + 2 * along, torch.ones(1)])
    torch.testing.assert_close(point[:3], torch.stack([0 * along[0], 0 * along[0], 2 * along.norm()]))
    rotation = camera.viewmat[:3, :3]
    torch.testing.assert_close(rotation @ rotation.T, torch.eye(3, dtype=torch.float64))
    assert torch.linalg.det(rotation) > 0


def test_outside_of_the_viewer_no_control_acts(run):
    camera = run.cameras("test")[0].camera
    before = run.model._view_outputs(camera, run.background)
    choose(run, mode="band", slider=2.0, budget=0.01, gaze="middle", filter="xray", focus="click")
    run.model.controls.point(None, *click_of(run))
    shown(run)
    after = run.model._view_outputs(camera, run.background)
    assert set(before) == set(after)
    assert all(torch.equal(before[name], after[name]) for name in before)


# -- the page ---------------------------------------------------------------------------------------------------------


class Handle(SimpleNamespace):
    """As much of a viser handle as elements need."""

    def on_update(self, hook):
        self.hooks.append(hook)

    on_click = on_update

    def use(self, value, client=None):
        self.value = value
        for hook in self.hooks:
            hook(SimpleNamespace(client=client))


class Server:
    """As much of viser as a panel needs."""

    def __init__(self):
        self.gui, self.handles, self.left = self, {}, []

    def __getattr__(self, name):
        if not name.startswith("add_"):
            raise AttributeError(name)

        def add(label, *values, visible=True, **more):
            value = more.get("label", label)
            given = {"add_dropdown": values[1:2], "add_slider": values[3:4]}.get(name, values[:1])
            handle = Handle(value=given[0] if given else None, visible=visible, content=value, hooks=[])
            self.handles["Note" if name == "add_markdown" else value] = handle
            return handle

        def labelled(*values, **more):
            return add(more.pop("label"), *values, **more) if "label" in more else add(*values, **more)

        return labelled

    def on_client_disconnect(self, act):
        self.left.append(act)


class Scene:
    def __init__(self):
        self.act = None

    def on_pointer_event(self, event_type):
        assert event_type == "click"
        return lambda act: setattr(self, "act", act)

    def remove_pointer_callback(self):
        assert self.act is not None
        self.act = None


def client(number):
    return SimpleNamespace(client_id=number, scene=Scene())


def installed():
    panel, server = Panel(lod_slider(3), ("prefix", "all", "band", "budget"), 3), Server()
    panel.install(server)
    drawings = []
    panel.cb_hook = lambda _: drawings.append(1)
    return panel, server.handles, drawings, server


def visible(handles):
    return {name for name, handle in handles.items() if handle.visible}


ALWAYS = {"Mode", "Gaze", "Filter", "Focus", "Drawn"}


def test_advanced_controls_are_hidden_until_their_mode_is_chosen():
    panel, handles, drawings, _ = installed()
    assert list(handles) == [
        *("Mode", "Level of detail", "Budget (thousands)"),
        *("Gaze", "Gaze radius", "Move the gaze", "Filter", "Focus", "Focus radius", "Move the focus"),
        *("Mask folder", "Find the object", "Drawn", "Note"),
    ]
    assert visible(handles) == ALWAYS | {"Level of detail"}
    handles["Mode"].use("budget")
    assert visible(handles) == ALWAYS | {"Level of detail", "Budget (thousands)"} and len(drawings) == 1
    handles["Mode"].use("all")
    assert visible(handles) == ALWAYS
    handles["Gaze"].use("middle")
    assert visible(handles) == ALWAYS | {"Gaze radius"}
    handles["Gaze"].use("click")
    handles["Focus"].use("click")
    assert visible(handles) == ALWAYS | {"Gaze radius", "Move the gaze", "Focus radius", "Move the focus"}
    handles["Focus"].use("masks")
    assert visible(handles) == ALWAYS | {"Gaze radius", "Move the gaze", "Mask folder", "Find the object"}
    handles["Gaze"].use("salient")
    handles["Focus"].use("off")
    assert visible(handles) == ALWAYS | {"Gaze radius"}
    panel.say("gaze", "Something.")
    assert handles["Note"].visible and handles["Note"].content == "Something."
    panel.say("focus", "More.")
    panel.say("gaze", None)
    assert handles["Note"].content == "More."
    panel.say("focus", None)
    assert not handles["Note"].visible
    drawings.clear()
    handles["Drawn"].value = "5 / 5, 1 ms"
    assert drawings == [] and handles["Drawn"].hooks == []


def test_without_several_levels_there_is_less_to_choose():
    for panel in (
        Panel(detail_slider(10.0), ("scale", "all", "budget"), 1),
        Panel(lod_slider(1), ("all", "budget"), 1),
    ):
        server = Server()
        panel.install(server)
        assert visible(server.handles) - {"Detail scale"} == {"Mode", "Drawn"}
        panel.gaze.value = "middle"
        assert panel.around(NOTHING, Surroundings(lambda: None, lambda: ([], []), {})) == []


def test_the_next_click_of_whoever_asked_places_the_gaze():
    panel, handles, drawings, server = installed()
    one, two = client(1), client(2)
    handles["Gaze"].use("click", one)
    assert "Click in the picture to place the gaze." in handles["Note"].content
    assert one.scene.act and two.scene.act is None
    drawings.clear()
    one.scene.act(SimpleNamespace(client_id=1, screen_pos=((0.25, 0.75),)))
    assert panel._clicks.of(1).gaze == (0.25, 0.75) and panel._clicks.of(2).gaze is None
    assert one.scene.act is None and drawings == [1] and not handles["Note"].visible
    handles["Move the gaze"].use(True, two)
    assert two.scene.act and one.scene.act is None
    handles["Gaze"].use("off", one)
    assert two.scene.act is None and not handles["Note"].visible
    server.left[0](one)
    assert panel._clicks.of(1).gaze is None


def test_the_next_click_places_the_focus_in_world_units():
    panel, handles, _, _ = installed()
    one = client(1)
    handles["Focus"].use("click", one)
    one.scene.act(SimpleNamespace(client_id=1, ray_origin=(10.0, -20.0, 5.0), ray_direction=(0.0, 0.0, 1.0)))
    assert panel._clicks.of(1).ray == ((1.0, -2.0, 0.5), (0.0, 0.0, 1.0))
    # of a program's own choice nobody can be asked to click
    handles["Focus"].use("click")
    assert one.scene.act is None


def test_a_client_that_has_left_is_not_waited_for():
    clicks, one = Clicks(), client(1)
    clicks.next(one, "gaze", lambda _: None)
    clicks.forget(1)
    clicks.cancel("gaze")
    assert one.scene.act is not None


def test_another_range_before_and_after_the_viewer_has_started():
    panel = Panel(lod_slider(3), ("prefix", "all", "band", "budget"), 3)
    panel.set_slider(lod_slider(2), 2)
    assert panel.slider.max == 2.0
    panel.install(Server())
    panel.set_slider(lod_slider(4), 4)
    assert panel.slider.max == 2.0 and isinstance(panel.mode, ViewerDropdown)


def test_gaussians_are_filtered_before_they_are_cropped(run):
    """Strokes are shifted by row: cropping first would shift others."""
    choose(run, filter="brush")
    filtered = apply_filter(run.gaussians, "brush")
    inside = filtered.means[:, 0] > filtered.means[:, 0].median()
    run.model.crop_box = SimpleNamespace(within=lambda means: (means[:, 0] > filtered.means[:, 0].median())[:, None])
    try:
        assert torch.equal(shown(run)["rgb"], drawn(run, gaussians=filtered.select(inside)))
    finally:
        run.model.crop_box = None
