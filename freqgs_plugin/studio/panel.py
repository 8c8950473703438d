"""The viewer's controls: one panel, what of it is shown when, and what it asks of a picture."""

import threading
from collections.abc import Callable, Sequence
from typing import Any, Literal

from nerfstudio.viewer.viewer_elements import ViewerButton, ViewerDropdown, ViewerElement, ViewerSlider

from freqgs_plugin.apps.filters import FILTERS
from freqgs_plugin.apps.focus import Focus
from freqgs_plugin.apps.foveation import Foveation
from freqgs_plugin.apps.gaze import salient_point
from freqgs_plugin.apps.geometry import GeometryIndex
from freqgs_plugin.apps.region import Ball
from freqgs_plugin.functional.attenuation import Attenuation
from freqgs_plugin.studio.clicking import Clicks, sight
from freqgs_plugin.studio.controls import (
    Note,
    budget_number,
    budget_of,
    drawn_text,
    focus_slider,
    gaze_slider,
    uninterrupted,
)
from freqgs_plugin.studio.masking import MaskedObject, Surroundings
from freqgs_plugin.types import Gaussians

Mode = Literal["all", "prefix", "band", "scale", "budget"]
MODES = {
    "all": "everything",
    "prefix": "levels up to the slider's",
    "band": "what the level nearest to the slider adds, around mid grey",
    "scale": "as if seen from as many times as far as the slider says",
    "budget": "the same, and at most so many Gaussians",
}
OFF, CLICK, MIDDLE, SALIENT, MASKS = "off", "click", "middle", "salient", "masks"


class Panel(ViewerElement[str]):
    """All controls of a model, as the one element of it that nerfstudio finds.

    nerfstudio would sort several by the names of their attributes. Values are common to all clients, as of nerfstudio's
    own controls; clicked places are kept for each. Only the threads that draw for the viewer ask what is set here.
    """

    def __init__(self, slider: ViewerSlider, modes: Sequence[Mode], levels: int):
        """The slider and its modes, of which the first is chosen; without several levels, nothing that needs them."""
        super().__init__("Controls")
        hint = "; ".join(f"{mode}: {MODES[mode]}" for mode in modes) + "."
        self.mode = ViewerDropdown("Mode", modes[0], list(modes), hint=hint)
        self.slider = slider
        self.budget = budget_number()
        hint = f"Full detail where one looks, and less farther out; {SALIENT}: at what stands out most."
        self.gaze = _choice("Gaze", [OFF, CLICK, MIDDLE, SALIENT], hint)
        self.gaze_radius = gaze_slider()
        self.gaze_button = _button("Move the gaze")
        self.filter = _choice("Filter", [OFF, *FILTERS], "Changes colours, places and opacities by level.")
        hint = f"Full detail around a clicked point, or of what {MASKS} mark, and level 1 elsewhere."
        self.focus = _choice("Focus", [OFF, CLICK, MASKS], hint)
        self.focus_radius = focus_slider()
        self.focus_button = _button("Move the focus")
        self.masked = MaskedObject(self.say, lambda: self.cb_hook(self))
        self.drawn = drawn_text()
        self.note = Note()
        self._levels = levels
        self._clicks = Clicks()
        self._notes: dict[str, str] = {}
        self._saying = threading.Lock()
        self._count: int | None = None
        self._arrange()

    # -- on the page ----------------------------------------------------------------------------------------------

    def elements(self) -> list[ViewerElement]:
        """From top to bottom."""
        return [
            *(self.mode, self.slider, self.budget),
            *(self.gaze, self.gaze_radius, self.gaze_button, self.filter),
            *(self.focus, self.focus_radius, self.focus_button, self.masked.folder, self.masked.button),
            *(self.drawn, self.note),
        ]

    def _create_gui_handle(self, viser_server: Any) -> None:
        raise NotImplementedError("the panel has elements, each with a handle of its own.")

    def install(self, viser_server: Any) -> None:
        for element in self.elements():
            if element not in (self.drawn, self.note, self.gaze_button, self.focus_button, *self._of_masks()):
                element.cb_hook = self._changed
            element.install(viser_server)
        for choice, button, wait in (
            (self.gaze, self.gaze_button, self._wait_for_gaze),
            (self.focus, self.focus_button, self._wait_for_focus),
        ):
            assert choice.gui_handle is not None
            choice.gui_handle.on_update(wait)
            button.gui_handle.on_click(wait)
        assert self.masked.button.gui_handle is not None
        self.masked.button.gui_handle.on_click(lambda _: self.masked.ask())
        viser_server.on_client_disconnect(lambda client: self._clicks.forget(client.client_id))

    def _of_masks(self) -> tuple[ViewerElement, ...]:
        return self.masked.folder, self.masked.button

    def set_slider(self, slider: ViewerSlider, levels: int) -> None:
        """Another range, before the viewer has started; then the old slider stays, which means the same."""
        if self.slider.gui_handle is None:
            self.slider, self._levels = slider, levels
            self._arrange()

    def _changed(self, _: Any) -> None:
        """Show what the choices need, and draw anew: nerfstudio has put that into `cb_hook`."""
        self._arrange()
        self.cb_hook(self)

    def _arrange(self) -> None:
        several = self._levels > 1
        gaze, focus = self.gaze.value, self.focus.value
        for element, visible in (
            (self.slider, self.mode.value != "all"),
            (self.budget, self.mode.value == "budget"),
            (self.gaze, several),
            (self.gaze_radius, gaze != OFF),
            (self.gaze_button, gaze == CLICK),
            (self.filter, several),
            (self.focus, several),
            (self.focus_radius, focus == CLICK),
            (self.focus_button, focus == CLICK),
            *((element, focus == MASKS) for element in self._of_masks()),
        ):
            _show(element, visible)

    def say(self, about: str, text: str | None) -> None:
        """Show a message about one of the controls; None: there is nothing (any longer) to say about it."""
        if self._notes.get(about) == text:
            return
        # several threads draw, and each may be interrupted
        with uninterrupted(), self._saying:
            self._notes.pop(about, None)
            if text:
                self._notes[about] = text
            self.note.value = "\n\n".join(self._notes.values())

    # -- clicks ---------------------------------------------------------------------------------------------------

    def _wait_for_gaze(self, event: Any) -> None:
        self._wait("gaze", self.gaze, event, lambda e: self.look(e.client_id, tuple(e.screen_pos[0])))

    def _wait_for_focus(self, event: Any) -> None:
        def act(clicked: Any) -> None:
            from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO as RATIO

            x, y, z = (coordinate / RATIO for coordinate in clicked.ray_origin)
            dx, dy, dz = clicked.ray_direction
            self.point(clicked.client_id, (x, y, z), (dx, dy, dz))

        self._wait("focus", self.focus, event, act)

    def _wait(self, about: str, choice: ViewerDropdown, event: Any, act: Callable[[Any], None]) -> None:
        """The next click of the client who has just chosen `click`, or pressed the button, is meant for `act`."""
        if choice.value == CLICK:
            if event.client is None:
                return
            self._clicks.next(event.client, about, act)
            self.say("click", f"Click in the picture to place the {about}.")
        else:
            self.say("click", None)
            self.say(about, None)
            self._clicks.cancel(about)

    def look(self, client_id: int | None, share: tuple[float, float]) -> None:
        """A client looks there: shares of the width and height of its picture, from the upper left corner."""
        x, y = (float(s) for s in share)
        self.say("click", None)
        if 0 <= x <= 1 and 0 <= y <= 1:
            self._clicks.of(client_id).gaze = (x, y)
            self.say("gaze", None)
        else:
            self.say("gaze", f"The gaze ({x:.2f}, {y:.2f}) lies outside of the picture, and the last one stays.")
        self.cb_hook(self)

    def point(
        self, client_id: int | None, origin: tuple[float, float, float], direction: tuple[float, float, float]
    ) -> None:
        """A client points along a ray (world units); the next picture drawn for it finds what that meets."""
        self.say("click", None)
        self._clicks.of(client_id).ray = (origin, direction)
        self.cb_hook(self)

    # -- what a picture for the client of this thread is to show --------------------------------------------------

    def count(self) -> int | None:
        """Gaussians that a view may have; None: as many as it takes. A number that is no budget changes nothing."""
        if self.mode.value != "budget":
            self.say("budget", None)
            return None
        thousands = float(self.budget.value)
        if 0 <= thousands < float("inf"):
            self._count = budget_of(self.budget)
            self.say("budget", None)
        else:
            last = "no bound" if self._count is None else f"{self._count:,} Gaussians"
            self.say("budget", f"The budget is {thousands:g}; it must be 0 (no bound) or more. The last stays: {last}.")
        return self._count

    def around(self, gaussians: Gaussians, surroundings: Surroundings) -> list[Attenuation]:
        """Gaze and focus."""
        found: list[Attenuation] = []
        if self._levels < 2:
            return found
        if self.gaze.value != OFF:
            gaze = self._gaze(surroundings)
            if gaze is not None:
                found.append(Foveation(gaze, radius=float(self.gaze_radius.value)))
        if self.focus.value != MASKS:
            self.masked.off()
        if self.focus.value == CLICK:
            self._find_target(gaussians)
            target = self._clicks.here().target
            if target is not None:
                found.append(Ball(target[0], float(self.focus_radius.value) * target[1]))
        elif self.focus.value == MASKS:
            rows = self.masked.rows(gaussians, surroundings)
            if rows is not None:
                found.append(Focus(rows))
        return found

    def _gaze(self, surroundings: Surroundings) -> tuple[float, float] | None:
        if self.gaze.value == MIDDLE:
            return 0.5, 0.5
        if self.gaze.value == SALIENT:
            return salient_point(surroundings.base())
        return self._clicks.here().gaze

    def _find_target(self, gaussians: Gaussians) -> None:
        """What the last click has met, if no picture has asked yet."""
        places = self._clicks.here()
        if places.ray is None:
            return
        (origin, direction), places.ray = places.ray, None
        try:
            hit = GeometryIndex(gaussians).pick(sight(origin, direction, gaussians.means), (0.5, 0.5))
        except ValueError as error:
            self.say("focus", f"Nothing can be picked: {error}")
            return
        if hit is None:
            self.say("focus", "Under the click is nothing of level 1, and the last focus stays.")
            return
        x, y, z = hit.point.tolist()
        places.target = ((x, y, z), hit.depth)
        self.say("focus", None)


def _choice(name: str, options: list[str], hint: str) -> ViewerDropdown:
    return ViewerDropdown(name, options[0], options, hint=hint)


def _button(name: str) -> ViewerButton:
    return ViewerButton(name, cb_hook=lambda _: None)


def _show(element: ViewerElement, visible: bool) -> None:
    """Now, or once it is installed."""
    element.visible = visible
    if element.gui_handle is not None:
        element.gui_handle.visible = visible
