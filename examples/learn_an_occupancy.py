"""Learns the occupancy of a scene, and asks it: learn_an_occupancy.py SCENE OUT [STEPS]"""

import argparse
import copy
from dataclasses import replace
from pathlib import Path

import torch
from nerfstudio.scripts.train import main as train

from leco_plugin.method_configs import leco_occupancy
from leco_plugin.occupancy import Occupancy
from leco_plugin.scenes.input_error import InputError


def learn(scene: Path, out: Path, steps: int) -> Path:
    """The file of the occupancy that a run of `leco-occupancy` leaves.

    Args:
        scene: folder in nerfstudio's format.
        out: folder for the run.
        steps: of training; at most half of them learn the occupancy.
    """
    config = copy.deepcopy(leco_occupancy.config)  # every option of `ns-train leco-occupancy`
    config.data, config.output_dir, config.max_num_iterations = scene, out, steps
    config.vis = "tensorboard"  # no viewer
    model = config.pipeline.model
    model.calibration = replace(model.calibration, image_price_db=0.03)  # for example
    train(config)
    return config.get_base_dir() / "occupancy.safetensors"


def describe(occupancy: Occupancy) -> None:
    """Prints what the occupancy skips, what that costs, and how full its space is."""
    report = occupancy.report
    print(f"{occupancy.num_params} values, threshold {occupancy.threshold:.3f}")
    print(f"skips {report['empty_fraction']:.1%} for {report['image_price_db']:+.3f} dB")
    center, half = occupancy.space.center, occupancy.space.half_extent
    positions = center + half * (2.0 * torch.rand(10_000, 3) - 1.0)  # [N, 3], the run's units
    o = occupancy.query(positions)  # [N] in [0, 1]
    kept = occupancy.occupied(positions)  # [N] bool: o >= the threshold
    print(f"of its space {kept.float().mean():.1%} is kept, where o(x) is {o[kept].mean():.2f}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition(":")[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("steps", type=int, nargs="?", default=4000)
    try:
        file = learn(**vars(parser.parse_args()))
    except InputError as error:
        parser.error(str(error))
    describe(Occupancy.load(file))
    print(f"the occupancy is in {file}")
