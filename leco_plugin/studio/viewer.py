"""nerfstudio's viewer: where it opens, and that nobody is shown the door when training ends."""

from __future__ import annotations

import math
import threading
import time
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np
import torch
import viser
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.viewer.render_state_machine import RenderStateMachine
from nerfstudio.viewer.viewer_elements import ViewerControl
from torch import Tensor

from leco_plugin.log import say
from leco_plugin.scenes.photographs import taken_from_above
from leco_plugin.scenes.survey import sparse_points

STEEPEST = 0.02
"""Of the steepest look of a survey, in the height of a unit vector: those that look down as well,
within 11 degrees of straight down."""
UPRIGHT = 0.05
"""Least part of a look that is level: straight down, controls that keep z upright lose the heading.
Three degrees."""
DOWNWARD = -0.7
"""Height of a look, a unit vector, below which it shows the ground rather than the horizon."""
WITHOUT_POINTS = 1.0
"""How far before the camera the middle of the scene is, scene units, where nothing is known."""
BEYOND_PICTURE = 1.2
"""The view begins so many times as far from the camera as the photograph in its frustum, which
would hide the scene."""

LOOKING = "somebody is looking: the viewer stays open until its last page is closed, or Ctrl-C"
LONGEST_CHUNK = 30.0
"""Seconds for which a picture that is to end is waited for."""


class View(NamedTuple):
    """A camera of the viewer, in scene units; z is up."""

    position: Tensor
    """[3]."""
    look_at: Tensor
    """[3], about which it turns."""
    half_size: tuple[float, float] | None
    """Tangents of half the horizontal and vertical angle of view; None leaves the viewer's."""

    def field_of_view(self, aspect: float) -> float | None:
        """Vertical angle, radians, with which a window of this aspect shows photographed space."""
        if self.half_size is None:
            return None
        across, up = self.half_size
        return 2.0 * math.atan(min(up, across / aspect))


def middle_view(poses: Tensor) -> int:
    """The training view in the middle, of OpenGL poses [C, 3, 4] with z up; of a survey from the
    air, of those that look most down."""
    places = poses[:, :, 3]
    distances = (places - places.median(dim=0).values).norm(dim=-1)
    if taken_from_above(poses.numpy()):
        steep = poses[:, 2, 2]
        distances = distances.masked_fill(steep < steep.max() - STEEPEST, torch.inf)
    return int(distances.argmin())


def first_view(cameras: Cameras, points: Tensor | None, frustum: float) -> View:
    """Where the viewer opens, by training cameras, sparse points [P, 3] or None, and the cube root
    of the volume of a camera's pyramid, all in scene units."""
    poses = cameras.camera_to_worlds.cpu().float()
    number = middle_view(poses)
    pose = poses[number]
    look, place = -pose[:, 2], pose[:, 3]
    ahead = WITHOUT_POINTS
    if points is not None and len(points):
        depths = (points.cpu().float() - place) @ look
        depths = depths[depths > 0.0]
        ahead = float(depths.median()) if len(depths) else ahead
    half_size, start = None, 0.0
    camera = cameras[number]
    if int(camera.camera_type) == CameraType.PERSPECTIVE.value:
        across, up = (
            float(side) / (2.0 * float(focal))
            for side, focal in ((camera.width, camera.fx), (camera.height, camera.fy))
        )
        half_size = across, up
        # the pyramid is scaled to that volume, whatever its shape
        start = BEYOND_PICTURE * frustum / (across * up / 3.0) ** (1.0 / 3.0)
    start = min(start, 0.5 * ahead)
    middle = place + ahead * look
    return View(middle - (ahead - start) * upright_look(pose), middle, half_size)


def upright_look(pose: Tensor) -> Tensor:
    """The look [3] of a camera with an OpenGL pose [3, 4], z up, or one close to it that shows the
    ground with the same top, for controls that keep z upright."""
    look, level = -pose[:, 2], pose[:2, 1]
    if look[2] > DOWNWARD or float(level.norm()) == 0.0:
        return look
    top = level / level.norm()
    ahead = (look[:2] @ top).clamp(min=UPRIGHT)
    return torch.nn.functional.normalize(torch.cat([ahead * top, look[2:]]), dim=0)


class FirstView(ViewerControl):
    """Opens nerfstudio's viewer on a training view.

    nerfstudio 1.1.5 leaves a new page at viser's own camera, from which many scenes show nothing.
    Its `ViewerControl.set_pose` is not implemented; `_setup`, which a viewer calls on each control
    that it finds in a model, is what a control has to get hold of viser's server.
    """

    def _setup(self, viewer: Any) -> None:
        from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO as SCALE

        super()._setup(viewer)
        dataset = viewer.pipeline.datamanager.train_dataset
        frustum = viewer.config.camera_frustum_scale / SCALE
        view = first_view(dataset.cameras, sparse_points(dataset), frustum)

        def open_on_view(client: viser.ClientHandle) -> None:
            camera, fitted = client.camera, 0.0

            def fit(_: Any) -> None:
                # a new page has no panels yet, so that its picture is wider than it will be
                nonlocal fitted
                fov = view.field_of_view(camera.aspect)
                if fov is not None and camera.aspect != fitted:
                    camera.fov, fitted = fov, camera.aspect

            with client.atomic():
                camera.up_direction = np.array([0.0, 0.0, 1.0])
                camera.position = SCALE * view.position.double().numpy()
                camera.look_at = SCALE * view.look_at.double().numpy()
                fit(camera)
            camera.on_update(fit)

        viewer.viser_server.on_client_connect(open_on_view)


def stay_open(viewer: Any) -> None:
    """Returns when the last page of nerfstudio's viewer, if there is one, is closed, or after
    Ctrl-C.

    nerfstudio 1.1.5 either ends with training, whoever is looking, or waits for Ctrl-C even where
    nobody is (`viewer.quit_on_train_completion`).
    """
    server = getattr(viewer, "viser_server", None)
    if not isinstance(server, viser.ViserServer):
        return
    try:
        if server.get_clients():
            say(LOOKING)
            with suppress(KeyError):  # of a page that closes or opens just now
                viewer._trigger_rerender()  # what has been trained since the last picture
            while server.get_clients():
                time.sleep(0.2)
    except KeyboardInterrupt:
        say("the viewer is closed")
    with suppress(KeyboardInterrupt):  # of somebody who presses Ctrl-C twice
        stop_drawing()


def stop_drawing() -> None:
    """Ends the threads in which nerfstudio's viewers draw: Python ends in an abort where one is in
    the middle of a picture."""
    for thread in threading.enumerate():
        if isinstance(thread, RenderStateMachine):
            thread.running = False
            thread.join(LONGEST_CHUNK)
