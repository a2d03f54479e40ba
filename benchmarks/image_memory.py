"""Peak memory of learning an occupancy on many photographs: `python benchmarks/image_memory.py`.

Photographs are generated; each way to hold them is measured in a process of its own, as the highest
resident memory beyond what the process holds when everything is imported. The same on photographs
of a tenth of the size, taken off, leaves what the photographs take. Nothing is learned in so few
steps; all that a run does with photographs happens in them.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from PIL import Image

WAYS = ("disk", "some", "parallel", "memory")


@dataclass
class Options:
    """Settings of the benchmark."""

    images: int = 60
    """Photographs."""
    width: int = 2000
    """Of each, pixels."""
    height: int = 1500
    """Of each, pixels."""
    steps: int = 8
    """Learning steps, then the gate is calibrated and frozen."""
    ways: tuple[Literal["disk", "some", "parallel", "memory"], ...] = ("disk", "some")
    """disk: decoded once into files of which pixels are read. some: nerfstudio's own eight images
    at a time. parallel: its parallel data manager. memory: all images decoded, its default."""
    folder: Path | None = None
    """Where the photographs go; by default a folder that is removed afterwards."""
    out: Path = Path(__file__).parent / "results" / "image-memory.json"
    """Where the figures go."""
    measure: Literal["disk", "some", "parallel", "memory"] | None = None
    """Measures one way in this process and prints it; what the benchmark starts."""


def write_photographs(folder: Path, options: Options) -> Path:
    """A survey from the air whose pictures are waves of colour: as large as any, fast to make."""
    (folder / "images").mkdir(parents=True, exist_ok=True)
    rows, columns = np.mgrid[: options.height, : options.width].astype(np.float32)
    frames = []
    for number in range(options.images):
        name = f"images/{number:04d}.jpg"
        place = np.array([number % 10 - 4.5, number // 10 - 2.5, 6.0])
        pose = np.eye(4)
        pose[:3, 3] = place
        frames.append({"file_path": name, "transform_matrix": pose.tolist()})
        if (folder / name).exists():
            continue
        waves = [np.sin(rows / (31 + number) + k) + np.cos(columns / 47 + k) for k in range(3)]
        pixels = (127.5 + 63.0 * np.stack(waves, axis=-1)).astype(np.uint8)
        Image.fromarray(pixels).save(folder / name, quality=80)
    names = [frame["file_path"] for frame in frames]
    scene: dict[str, Any] = {
        "camera_model": "OPENCV",
        "w": options.width,
        "h": options.height,
        "fl_x": options.width,
        "fl_y": options.width,
        "cx": options.width / 2,
        "cy": options.height / 2,
        "orientation_override": "none",
        "train_filenames": names[1:],
        "val_filenames": names[:1],
        "test_filenames": names[:1],
        "frames": frames,
    }
    (folder / "transforms.json").write_text(json.dumps(scene))
    return folder


def measure(way: str, folder: Path, steps: int) -> dict[str, Any]:
    """Learns for some steps with photographs held in one way: peak and baseline, bytes."""
    from nerfstudio.data.datamanagers.parallel_datamanager import ParallelDataManagerConfig
    from nerfstudio.pipelines.base_pipeline import VanillaPipelineConfig

    from leco_plugin.evaluation.peak_memory import peak_process_bytes
    from leco_plugin.models.learn_first import learn_occupancy
    from leco_plugin.models.leco_config import LecoModelConfig
    from leco_plugin.models.phases import ScheduleConfig
    from leco_plugin.scenes.data_manager import LecoDataManagerConfig, decoded_bytes
    from leco_plugin.scenes.known_distances import KnownDistancePixelSamplerConfig
    from leco_plugin.scenes.photographs import LecoPhotographsDataParserConfig

    common: dict[str, Any] = {
        "dataparser": LecoPhotographsDataParserConfig(data=folder),
        "train_num_rays_per_batch": 512,
        "pixel_sampler": KnownDistancePixelSamplerConfig(),
    }
    config: Any
    if way == "parallel":
        config = ParallelDataManagerConfig(**common)
    elif way == "some":
        some = {"train_num_images_to_sample_from": 8, "train_num_times_to_repeat_images": 4}
        config = LecoDataManagerConfig(images="memory", **some, **common)
    else:
        config = LecoDataManagerConfig(images=way, pixels=folder / "pixels", **common)
    model = LecoModelConfig(schedule=ScheduleConfig(learn_steps=steps))
    before = peak_process_bytes()
    pipeline: Any = VanillaPipelineConfig(datamanager=config, model=model).setup(device="cpu")
    learn_occupancy(model, pipeline, rays=512)
    dataset = pipeline.datamanager.train_dataset
    elsewhere = 0
    for process in getattr(pipeline.datamanager, "data_procs", []):
        status = Path(f"/proc/{process.pid}/status").read_text().splitlines()
        elsewhere += int(next(x for x in status if x.startswith("VmHWM:")).split()[1]) * 1024
        process.terminate()
        process.join()
    return {
        "way": way,
        "decoded_float_bytes": decoded_bytes(dataset),
        "decoded_bytes": decoded_bytes(dataset) // 4,
        "baseline_bytes": before,
        "peak_bytes": peak_process_bytes(),
        "added_bytes": peak_process_bytes() - before + elsewhere,
        "other_processes_bytes": elsewhere,
    }


def in_its_own_process(way: str, folder: Path, steps: int) -> dict[str, Any]:
    """What `measure` says in a new process."""
    command = [sys.executable, "-W", "ignore", __file__, "--measure", way]
    command += ["--folder", str(folder), "--steps", str(steps)]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    measured: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return measured


def main(options: Options) -> None:
    if options.measure is not None:
        assert options.folder is not None
        print(json.dumps(measure(options.measure, options.folder, options.steps)))
        return
    from leco_plugin.evaluation.machine import describe_machine

    rows = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = write_photographs(options.folder or Path(temporary) / "full", options)
        tenth = replace(options, width=options.width // 10, height=options.height // 10)
        small = write_photographs(Path(temporary) / "tenth", tenth)
        for way in options.ways:
            row, without = (in_its_own_process(way, of, options.steps) for of in (folder, small))
            row["added_on_a_tenth_bytes"] = without["added_bytes"]
            row["photographs_bytes"] = row["added_bytes"] - without["added_bytes"]
            share = row["photographs_bytes"] / row["decoded_bytes"]
            print(f"{way}: {row['photographs_bytes'] / 1e6:.0f} MB, {share:.2f} of decoded bytes")
            rows.append(row)
    results = {
        "format": 1,
        "machine": describe_machine(),
        "photographs": [options.images, options.width, options.height],
        "runs": rows,
    }
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(results, indent=2) + "\n")


if __name__ == "__main__":
    main(tyro.cli(Options))
