"""The object that a folder of masks marks, looked for while the viewer goes on drawing."""

import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from nerfstudio.viewer.viewer_elements import ViewerButton, ViewerText
from torch import Tensor

from freqgs_plugin.apps.focus import vote_in_folder
from freqgs_plugin.types import Camera, Gaussians


@dataclass(frozen=True)
class Surroundings:
    """What gaze and focus may ask of the model that draws."""

    base: Callable[[], Float[np.ndarray, "h w 3"]]
    """a small picture of level 1, as the client of this thread sees it"""
    views: Callable[[], tuple[list[str], list[Camera]]]
    """names and cameras of all photographs"""
    drawing: dict[str, Any]
    """`rasterizer` and `antialiased`"""


class MaskedObject:
    """Text field, button, and what was found last; a vote runs in a thread of its own, and the newest one counts."""

    def __init__(self, say: Callable[[str, str | None], None], redraw: Callable[[], None]):
        """`say` shows a message about a subject, or takes it back (None); `redraw` asks for a new picture."""
        self.folder = ViewerText("Mask folder", "", visible=False, hint="PNG files called like the photographs.")
        self.button = ViewerButton("Find the object", cb_hook=lambda _: None, visible=False)
        self._say, self._redraw = say, redraw
        self._asked: str | None = None
        self._newest = 0
        self._lock = threading.Lock()
        self._rows: Bool[Tensor, " n"] | None = None

    def ask(self) -> None:
        """The next picture starts to look for what the folder marks."""
        self._asked = self.folder.value.strip()
        if not self._asked:
            self._asked = None
            self._say("masks", f"No folder of masks is named; type its path.{self._kept()}")
            return
        self._redraw()

    def rows(self, gaussians: Gaussians, around: Surroundings) -> Bool[Tensor, " n"] | None:
        """The object's rows of `gaussians`, from the last search that found something; None: there are none.

        Starts a search that was asked for. Rows of a scene that has another number of Gaussians are of no use.
        """
        with self._lock:
            asked, self._asked = self._asked, None
            self._newest += asked is not None
            number = self._newest
        if asked is not None:
            self._say("masks", f"Looking for the object that the masks in {asked} mark ...")
            # in training the optimizer writes into what is drawn
            copied = replace(gaussians, **{k: v.clone() for k, v in vars(gaussians).items() if isinstance(v, Tensor)})
            threading.Thread(target=self._find, args=(number, asked, copied, around), daemon=True).start()
        rows = self._rows
        if rows is None:
            return None
        if len(rows) != len(gaussians):
            text = f"The object was found among {len(rows):,} Gaussians, and now there are {len(gaussians):,}: press "
            self._say("stale", f"{text}*{self.button.name}* again.")
            return None
        self._say("stale", None)
        return rows

    def off(self) -> None:
        """Another focus was chosen: nothing is to be said about masks."""
        for about in ("masks", "stale"):
            self._say(about, None)

    def _find(self, number: int, folder: str, gaussians: Gaussians, around: Surroundings) -> None:
        try:
            names, cameras = around.views()
            found = vote_in_folder(gaussians, names, cameras, Path(folder).expanduser(), **around.drawing)
        # whatever it is, the viewer goes on, and its user is told
        except Exception as error:
            self._tell(number, f"{error}{self._kept()}" if isinstance(error, ValueError | OSError) else repr(error))
            return
        with self._lock:
            if number != self._newest:
                return
            self._rows = found.rows.to(gaussians.means.device)
        self._tell(number, f"The object has {found.count:,} Gaussians.")
        self._redraw()

    def _tell(self, number: int, text: str) -> None:
        if number == self._newest:
            self._say("masks", text)

    def _kept(self) -> str:
        return "" if self._rows is None else " The last object stays."
