"""The controls of nerfstudio's viewer change what it draws, and nothing else."""

from __future__ import annotations

import copy
import threading
from pathlib import Path
from typing import Any

import pytest
import torch
from ball_occupancy import CENTRE, MARCH, ball, rays
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.viewer.render_state_machine import RenderStateMachine
from nerfstudio.viewer_legacy.server.viewer_utils import IOChangeException
from tiny_run import tiny_trainer
from torch import nn

from leco_plugin.hosts.guide import Guide
from leco_plugin.hosts.guided import GuidedHost
from leco_plugin.hosts.guided_start import OccupancyConfig
from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.gate import GateConfig
from leco_plugin.occupancy import SHOWN, Occupancy
from leco_plugin.studio import occupancy_view
from leco_plugin.studio.occupancy_view import (
    COLOURS,
    NOT_YET,
    STRENGTHS,
    Drawn,
    OccupancyView,
    with_states,
)
from leco_plugin.studio.viewer import stop_drawing

GATE = GateConfig(encoding=EncodingConfig(octaves=2), layers=1, width=8)


class Taker(nn.Module):
    """A host that takes any estimator."""

    def sample_with(self, estimator: nn.Module) -> None:
        self.estimator = estimator

    def forward(self, bundle: Any) -> dict[str, Any]:
        found = self.estimator.sampling(bundle.origins, bundle.directions, **MARCH)  # type: ignore[operator]
        return {"rgb": torch.zeros(len(bundle.origins), 3), "samples": len(found[0])}


class GuidedTaker(GuidedHost, Taker):
    """The same, guided."""


def bundle_of(origins: torch.Tensor, directions: torch.Tensor) -> RayBundle:
    return RayBundle(origins, directions, torch.ones(len(origins), 1))


@pytest.fixture
def host(guide: Guide, without_cache: None) -> Any:
    made: Any = GuidedTaker().eval()
    made.begin_guided(guide, OccupancyConfig())
    return made


def draw(monkeypatch: pytest.MonkeyPatch, model: Any, bundle: RayBundle) -> dict[str, Any]:
    """Outputs as a thread of the viewer gets them."""
    with monkeypatch.context() as patched:
        patched.setattr(occupancy_view, "is_viewer_drawing", lambda: True)
        return model(bundle)


def test_the_slider_changes_what_is_drawn_only(host: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    bundle = bundle_of(*rays())
    own = host(bundle)["samples"]
    assert draw(monkeypatch, host, bundle)["samples"] == own > 0
    host.leco_view.keep_from.value = 1.0
    assert draw(monkeypatch, host, bundle)["samples"] == 0
    assert host(bundle)["samples"] == own and host.leco_guide.followed().threshold == 0.5
    host.leco_view.keep_from.value = 0.001
    assert draw(monkeypatch, host, bundle)["samples"] > own


def test_the_slider_overrules_the_lower_threshold_that_a_host_begins_with(
    host: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    bundle = bundle_of(*rays())
    host.leco_guide.watched.lower = 0.1
    assert draw(monkeypatch, host, bundle)["samples"] > 0
    host.leco_view.keep_from.value = 1.0
    assert draw(monkeypatch, host, bundle)["samples"] == 0


def test_leco_occupancy_is_drawn_at_the_sliders_threshold(
    tiny_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = tiny_trainer(tiny_scene, tmp_path, GATE, candidates=32).pipeline.model.eval()
    origins, directions = torch.tensor([[0.0, 0.0, 0.5]] * 2), torch.eye(3)[:2]
    bundle = bundle_of(origins, directions)
    assert draw(monkeypatch, model, bundle).keys() == model(bundle).keys()
    assert model.leco_view.used.value == NOT_YET
    model.mixture.freeze(1e-3, {})
    own = model(bundle)["samples_per_ray"]
    assert torch.equal(draw(monkeypatch, model, bundle)["samples_per_ray"], own)
    model.leco_view.keep_from.value = 1.0
    assert bool((draw(monkeypatch, model, bundle)["samples_per_ray"] < own).all())
    assert torch.equal(model(bundle)["samples_per_ray"], own)


def test_what_an_interrupted_picture_leaves_reaches_no_other_thread() -> None:
    SHOWN.set(0.7)
    seen: list[float | None] = []
    thread = threading.Thread(target=lambda: seen.append(SHOWN.get()))
    thread.start()
    thread.join()
    SHOWN.set(None)
    assert seen == [None]


def test_no_picture_is_finished_for_a_closed_page(host: Any) -> None:
    raised: list[Exception] = []

    class Page(RenderStateMachine):
        def __init__(self) -> None:
            threading.Thread.__init__(self)
            self.running = True

        def run(self) -> None:
            try:
                while True:
                    host(bundle_of(*rays()))
            except IOChangeException as error:
                raised.append(error)

    Page().start()
    stop_drawing()
    assert len(raised) == 1


def test_a_slider_that_nobody_has_moved_follows_the_run() -> None:
    view = OccupancyView()
    view.follow(0.12345)
    assert (view.used.value, view.keep_from.value) == ("0.1235", 0.123)
    assert view.chosen() is None
    view.follow(0.3)
    assert view.keep_from.value == 0.3
    for value, chosen in ((0.3009, None), (0.2991, None), (0.3011, 0.3011), (0.2989, 0.2989)):
        view.keep_from.value = value
        assert view.chosen() == chosen
    view.keep_from.value = 0.8
    view.follow(0.2)
    assert (view.used.value, view.chosen()) == ("0.2", 0.8)


def test_the_overlay_colours_what_is_kept(host: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    known = copy.deepcopy(ball())
    half_seen = Occupancy(known.gate, known.space, 0.5, report=known.report)
    half_seen.seen.cells[:, 32:] = False  # beyond the middle in y
    host.leco_guide.set_occupancy(half_seen.eval())
    origins = torch.tensor(CENTRE) + torch.tensor([0.0, 0.0, 4.0])
    aims = torch.tensor(CENTRE) + torch.tensor([[0.0, -0.4, 0], [0, -1.7, 0], [0, 1.7, 0]])
    directions = torch.nn.functional.normalize(aims - origins, dim=-1)
    bundle = bundle_of(origins.expand(3, 3), directions)
    assert not draw(monkeypatch, host, bundle)["rgb"].any()
    host.leco_view.overlay.value = True
    drawn = torch.nn.functional.normalize(draw(monkeypatch, host, bundle)["rgb"], dim=-1)
    skipped, kept, unseen = torch.nn.functional.normalize(torch.tensor(COLOURS), dim=-1)
    torch.testing.assert_close(drawn, torch.stack([kept, skipped, unseen]))
    assert not host(bundle)["rgb"].any()


def test_a_crop_of_the_overlay_is_in_the_hosts_units() -> None:
    """The host is half as large as the ball's coordinates: its rays meet the ball from 1.5 to 2.5,
    which lies in the crop of the first one alone."""
    origins = (torch.tensor(CENTRE) + torch.tensor([0.0, 0.0, 4.0])).expand(2, 3) / 2.0
    bundle = bundle_of(origins, torch.tensor([[0.0, 0.0, -1.0]]).expand(2, 3))
    bundle.nears, bundle.fars = torch.tensor([[0.0], [2.8]]), torch.tensor([[2.0], [9.0]])
    drawn = with_states(torch.zeros(2, 3), Drawn(ball(), 2.0 * torch.eye(3, 4)), bundle)
    (skipped, kept, _), strengths = torch.tensor(COLOURS), STRENGTHS
    torch.testing.assert_close(drawn, torch.stack([strengths[1] * kept, strengths[0] * skipped]))


def test_a_copy_has_controls_of_its_own(host: Any) -> None:
    host.leco_view.keep_from.gui_handle = threading.Lock()  # as one of a viewer, it has no copy
    assert copy.deepcopy(host).leco_view.keep_from.gui_handle is None


def test_a_host_without_an_occupancy_has_no_controls() -> None:
    host: Any = GuidedTaker()
    host.begin_guided(Guide("dense"), OccupancyConfig())
    assert not hasattr(host, "leco_view")
