"""What nerfstudio's viewer shows of an occupancy: its controls, and the pictures that they change.

One piece for `leco-occupancy` and for all guided hosts. nerfstudio 1.1.5 finds the controls by
walking through a model's modules (`nerfstudio.viewer.utils.parse_object`), and draws in threads of
its own (`RenderStateMachine`): only there do the controls act. Training, evaluation and what is
saved keep the run's threshold.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from nerfstudio.models.base_model import Model
from nerfstudio.viewer.render_state_machine import RenderStateMachine
from nerfstudio.viewer.viewer_elements import ViewerCheckbox, ViewerSlider, ViewerText
from nerfstudio.viewer_legacy.server.viewer_utils import IOChangeException
from torch import Tensor, nn

from leco_plugin.evaluation.inspection import ray_states
from leco_plugin.occupancy import SHOWN, Occupancy
from leco_plugin.scenes.frames import moved, turned
from leco_plugin.studio.viewer import FirstView

if TYPE_CHECKING:
    ModelAfter = Model
else:
    ModelAfter = object  # what follows a class of ours among the bases is the model

STEP = 1e-3
"""Of the slider, and the most by which it stands beside the run's threshold at rest."""
COLOURS = ((0.20, 0.45, 1.00), (0.25, 0.95, 0.35), (0.55, 0.55, 0.55))
"""Of `SKIPPED`, `KEPT` and `UNSEEN`."""
STRENGTHS = (0.5, 0.25, 0.8)
"""Of those colours over the picture."""
NOT_YET = "not calibrated yet"


class Drawn(NamedTuple):
    """What a model draws by."""

    occupancy: Occupancy
    """Frozen, with the run's own threshold."""
    frame: Tensor | None
    """[3, 4] takes positions of the model to those of the occupancy; None is the same place."""


def is_viewer_drawing() -> bool:
    """Whether the current thread draws for nerfstudio's viewer."""
    return isinstance(threading.current_thread(), RenderStateMachine)


def stop_drawing_for_nobody() -> None:
    """Raises the IOChangeException that nerfstudio's viewer expects, in a picture whose page is
    closed: else it is finished, and no step of training is taken meanwhile."""
    thread = threading.current_thread()
    if isinstance(thread, RenderStateMachine) and not thread.running:
        raise IOChangeException


class OccupancyView(nn.Module):
    """Controls of an occupancy in nerfstudio's viewer. It has no state that is saved."""

    def __init__(self) -> None:
        super().__init__()
        self.used = ViewerText("Threshold of the run", NOT_YET, disabled=True)
        hint = "Draws with another threshold. The run and what it saves keep their own."
        self.keep_from = ViewerSlider("Keep o(x) from", 0.0, 0.0, 1.0, STEP, hint=hint)
        hint = "Over rgb. Green: the gate keeps something on this ray. Blue: it skips all. "
        hint += "Grey: it skips all, and no photograph shows part of it."
        self.overlay = ViewerCheckbox("Kept, skipped, unseen", False, hint=hint)
        self.first_view = FirstView()
        self._own: float | None = None

    def __deepcopy__(self, memo: dict[int, Any]) -> OccupancyView:
        """New controls: those of a viewer hold its server."""
        return OccupancyView()

    def chosen(self) -> float | None:
        """The threshold that somebody has moved the slider to; None is the run's own."""
        value = float(self.keep_from.value)
        return None if self._own is None or abs(value - self._own) <= STEP else value

    def follow(self, own: float) -> None:
        """Shows the run's threshold, which it finds and changes while it trains. A slider that
        nobody has moved goes with it."""
        if own == self._own:
            return
        untouched = self.chosen() is None
        self._own = own
        self.used.value = f"{own:.4g}"
        if untouched:
            self.keep_from.value = round(own, 3)

    def draw(
        self, drawn: Drawn, rays: Any, render: Callable[[Any], dict[str, Any]]
    ) -> dict[str, Any]:
        """Outputs of rays, a bundle [R] without limits but those of a crop, that a model renders as
        the controls have them."""
        self.follow(drawn.occupancy.threshold)
        threshold = self.chosen()
        SHOWN.set(threshold)
        try:
            outputs = render(rays)
        finally:
            SHOWN.set(None)
        if self.overlay.value and "rgb" in outputs:
            if threshold is not None:
                drawn = drawn._replace(occupancy=drawn.occupancy.with_threshold(threshold))
            outputs = outputs | {"rgb": with_states(outputs["rgb"], drawn, rays)}
        return outputs


def with_states(rgb: Tensor, drawn: Drawn, rays: Any) -> Tensor:
    """Colours [R, 3] of a picture with those of what the occupancy says along its rays."""
    origins, directions = rays.origins, rays.directions
    if drawn.frame is not None:
        origins, directions = moved(origins, drawn.frame), turned(directions, drawn.frame)
    lengths = directions.norm(dim=-1, keepdim=True)
    near, far = (None if each is None else each * lengths for each in (rays.nears, rays.fars))
    states = ray_states(drawn.occupancy, origins, directions / lengths, (near, far))
    strengths = torch.tensor(STRENGTHS).to(rgb)[states][:, None]
    return torch.lerp(rgb, torch.tensor(COLOURS).to(rgb)[states], strengths)


class DrawnInViewer(ModelAfter):
    """Stands before a model whose occupancy nerfstudio's viewer shows; one without `leco_view`, the
    controls, has none to show."""

    leco_view: OccupancyView

    def leco_drawn(self) -> Drawn | None:
        """What is drawn by; None while there is no frozen occupancy."""
        raise NotImplementedError

    def forward(self, ray_bundle: Any, *args: Any, **kwargs: Any) -> dict[str, Any]:
        """As the model's; in the viewer, as its controls have it."""
        stop_drawing_for_nobody()
        if "leco_view" in self._modules and is_viewer_drawing():
            SHOWN.set(None)  # whatever a picture that was interrupted has left
            drawn = self.leco_drawn()
            if drawn is not None:
                forward = super().forward
                return self.leco_view.draw(
                    drawn, ray_bundle, lambda rays: forward(rays, *args, **kwargs)
                )
        outputs: dict[str, Any] = super().forward(ray_bundle, *args, **kwargs)
        return outputs
