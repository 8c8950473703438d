"""Viewer controls, and what they say about how to draw. They touch pictures in the viewer only, never training."""

import math
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from nerfstudio.viewer.viewer_elements import ViewerElement, ViewerNumber, ViewerSlider, ViewerText

from freqgs_plugin.functional.attenuation import LevelCut


def in_viewer() -> bool:
    """Whether this is one of the viewer's render threads.

    Training, ns-eval and ns-render call the same model methods; a slider must not change their pictures.
    """
    from nerfstudio.viewer.render_state_machine import RenderStateMachine

    return isinstance(threading.current_thread(), RenderStateMachine)


@contextmanager
def uninterrupted() -> Iterator[None]:
    """A block that the viewer does not interrupt.

    It abandons a render by raising from a trace function on whatever line comes next. In the middle of an import that
    leaves a broken module behind, and while numba loads a kernel it becomes a SystemError: the thread that draws dies.
    """
    trace = sys.gettrace()
    sys.settrace(None)
    try:
        yield
    finally:
        sys.settrace(trace)


def lod_slider(num_levels: int) -> ViewerSlider:
    """Slider over fractional levels 1..L, at L to begin with. nerfstudio draws anew whenever it moves."""
    return ViewerSlider(
        name="Level of detail",
        default_value=float(num_levels),
        min_value=1.0,
        max_value=float(max(num_levels, 2)),
        step=0.05,
        disabled=num_levels == 1,
        hint="Draws levels up to this one; a fraction fades the next level in.",
    )


def detail_slider(largest: float) -> ViewerSlider:
    """Slider over virtual distance scales 1..`largest`, at 1 to begin with."""
    return ViewerSlider(
        name="Detail scale",
        default_value=1.0,
        min_value=1.0,
        max_value=float(largest),
        step=0.05,
        hint="Draws the scene as if seen from so many times as far: 1 is everything, more is fewer Gaussians.",
    )


class TenthsNumber(ViewerNumber):
    """A number with one decimal; viser would round what is typed to whole ones, as the number at first is."""

    def _create_gui_handle(self, viser_server: Any) -> None:
        self.gui_handle = viser_server.gui.add_number(
            self.name, self.default_value, step=0.1, disabled=self.disabled, visible=self.visible, hint=self.hint
        )


def budget_number() -> ViewerNumber:
    """How many thousand Gaussians a view may have; 0: as many as it takes."""
    return TenthsNumber(
        name="Budget (thousands)",
        default_value=0.0,
        hint="Draws at most so many thousand Gaussians, those that show most; 0: no bound.",
        visible=False,
    )


def budget_of(number: ViewerNumber) -> int | None:
    """The Gaussians that the number allows, at least 1; None without a bound (0, less, or no number)."""
    value = float(number.value)
    return max(round(1000 * value), 1) if 0 < value < math.inf else None


class WrittenText(ViewerText):
    """Text that only the program writes.

    viser calls the hook of an input whenever its value changes, and nerfstudio hooks a new render to every input: text
    written by a render would ask for the next one, for ever.
    """

    def install(self, viser_server: Any) -> None:
        self._create_gui_handle(viser_server)


def drawn_text() -> ViewerText:
    """Read-only text: Gaussians drawn, of how many, and the time it took."""
    return WrittenText(name="Drawn", default_value="-", disabled=True, hint="Gaussians drawn / all, render time")


class Note(ViewerElement[str]):
    """Lines of text that only the program writes, hidden while there are none."""

    def __init__(self) -> None:
        super().__init__("Note", visible=False)
        self._text = ""

    def _create_gui_handle(self, viser_server: Any) -> None:
        self.gui_handle = viser_server.gui.add_markdown(self._text, visible=self.visible)

    def install(self, viser_server: Any) -> None:
        self._create_gui_handle(viser_server)

    @property
    def value(self) -> str:
        return self._text

    @value.setter
    def value(self, text: str) -> None:
        self._text, self.visible = text, bool(text)
        handle: Any = self.gui_handle
        if handle is not None:
            handle.content, handle.visible = text, self.visible


def gaze_slider() -> ViewerSlider:
    """Slider over the radius of full detail around a gaze."""
    return ViewerSlider(
        name="Gaze radius",
        default_value=0.1,
        min_value=0.0,
        max_value=0.5,
        step=0.01,
        hint="Of the disc in which nothing is taken away: share of the picture's longer side.",
    )


def focus_slider() -> ViewerSlider:
    """Slider over the radius of full detail around a point in the world."""
    return ViewerSlider(
        name="Focus radius",
        default_value=0.2,
        min_value=0.02,
        max_value=1.0,
        step=0.02,
        hint="Of the ball around the clicked point: share of the distance from which it was clicked.",
    )


def level_cut(slider: ViewerSlider) -> LevelCut:
    """The attenuation that the slider asks for."""
    return LevelCut(float(slider.value))


def band_of(slider: ViewerSlider) -> int:
    """The whole level nearest to the slider."""
    return math.floor(float(slider.value) + 0.5)


class Stopwatch:
    """Milliseconds of a block, with CUDA's queue emptied before and after."""

    def __init__(self, device: torch.device):
        self._cuda = device.type == "cuda"
        self.milliseconds = 0.0

    def _now(self) -> float:
        if self._cuda:
            torch.cuda.synchronize()
        return time.perf_counter()

    def __enter__(self) -> "Stopwatch":
        self._start = self._now()
        return self

    def __exit__(self, *_: object) -> None:
        self.milliseconds = (self._now() - self._start) * 1e3
