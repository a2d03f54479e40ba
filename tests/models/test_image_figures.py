"""What is logged of an image."""

from __future__ import annotations

import math
from types import SimpleNamespace

import torch
from nerfstudio.model_components.renderers import RGBRenderer

from leco_plugin.models.figures import image_figures


def test_figures_are_floats_and_pictures_have_the_size_of_the_image() -> None:
    truth = torch.rand(12, 10, 3)
    outputs = {
        "rgb": truth + 2.0,
        "accumulation": torch.rand(12, 10, 1),
        "depth": torch.rand(12, 10, 1),
    }
    model = SimpleNamespace(renderer_rgb=RGBRenderer(background_color="black"))
    figures, pictures = image_figures(model, outputs, {"image": truth})
    assert all(isinstance(value, float) for value in figures.values())
    expected = -10.0 * math.log10(float(((1.0 - truth) ** 2).mean()))
    assert math.isclose(figures["psnr"], expected, rel_tol=1e-5)  # colours above one are white
    assert pictures["img"].shape == (12, 20, 3)
    assert pictures["depth"].shape == pictures["accumulation"].shape == (12, 10, 3)
