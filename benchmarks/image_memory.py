"""Peak memory of learning an occupancy on many photographs: `python benchmarks/image_memory.py`.

Photographs are generated, more than fit the allowance once they are decoded; each way to hold them
is measured in a process of its own, as the highest resident memory beyond what the process holds
when everything is imported. The kernel refuses what goes beyond the allowance. The same on
photographs of a tenth of the width and height tells what is not due to the photographs. Nothing is
learned in so few steps; all that a run does with photographs happens in them.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import checkout  # noqa: F401
import numpy as np
import tyro
from PIL import Image

Way = Literal["disk", "some", "parallel", "memory"]
OVER = ("can't allocate memory", "Cannot allocate memory", "MemoryError", "bad_alloc")
"""How a refused allocation ends in what a process says, by who has asked for it."""
HANGS = 300.0
"""Seconds after which a process waits for one that has died: nerfstudio's own for photographs."""


@dataclass
class Options:
    """Settings of the benchmark."""

    images: int = 240
    """Photographs."""
    width: int = 2000
    """Of each, pixels."""
    height: int = 1500
    """Of each, pixels."""
    steps: int = 8
    """Learning steps, then the gate is calibrated and frozen."""
    ways: tuple[Way, ...] = ("disk", "some", "parallel", "memory")
    """disk: decoded once into files of which pixels are read. some: nerfstudio's own eight images
    at a time. parallel: its parallel data manager, which decodes all in a process of its own.
    memory: all images decoded, its default."""
    allowance: int = 2_000_000_000
    """Bytes that each process may take beyond what it holds when everything is imported."""
    folder: Path | None = None
    """Where the photographs go; by default a folder that is removed afterwards."""
    out: Path = Path(__file__).parent / "results" / "image-memory.json"
    """Where the figures go."""
    measure: Way | None = None
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


def allow(more: int) -> None:
    """Lets the kernel refuse this process, and those it starts, so many bytes more than it has.

    Files that are mapped for reading do not count: the kernel drops their pages when it needs them.
    """
    import resource

    status = Path("/proc/self/status").read_text().splitlines()
    held = 1024 * int(next(line for line in status if line.startswith("VmData:")).split()[1])
    resource.setrlimit(resource.RLIMIT_DATA, (held + more, held + more))


def measure(way: Way, folder: Path, options: Options) -> dict[str, Any]:
    """Learns for some steps with photographs held in one way: peak and baseline, bytes."""
    from nerfstudio.data.datamanagers.parallel_datamanager import ParallelDataManagerConfig
    from nerfstudio.pipelines.base_pipeline import VanillaPipelineConfig

    from leco_plugin.evaluation.clock import peak_process_bytes
    from leco_plugin.hosts.learn_first import learn_occupancy
    from leco_plugin.learning.schedule import ScheduleConfig
    from leco_plugin.models.leco_config import LecoModelConfig
    from leco_plugin.scenes.data_manager import LecoDataManagerConfig, decoded_bytes
    from leco_plugin.scenes.photographs import LecoPhotographsDataParserConfig
    from leco_plugin.scenes.pixels.known_distances import KnownDistancePixelSamplerConfig

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
    model = LecoModelConfig(schedule=ScheduleConfig(learn_steps=options.steps))
    before = peak_process_bytes()
    allow(options.allowance)
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


def measure_in_process(way: Way, folder: Path, options: Options) -> dict[str, Any] | None:
    """What `measure` says in a new process; None where the allowance was not enough."""
    command = [sys.executable, "-W", "ignore", __file__, "--measure", way]
    command += ["--folder", str(folder), "--steps", str(options.steps)]
    command += ["--allowance", str(options.allowance)]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        try:
            said, complaint = process.communicate(timeout=HANGS)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            said, complaint = process.communicate()
    if process.returncode == 0:
        measured: dict[str, Any] = json.loads(said.splitlines()[-1])
        return measured
    if any(words in complaint for words in OVER):
        return None
    raise RuntimeError(f"photographs {way}:\n{complaint}")


def compared(way: Way, folder: Path, small: Path, options: Options) -> dict[str, Any]:
    """A row of the results: what a way takes, and how much of it is the photographs."""
    row = measure_in_process(way, folder, options)
    if row is None:
        return {"way": way, "within_allowance": False}
    without = measure_in_process(way, small, options)
    assert without is not None, "a tenth of the size takes more than the whole"
    row["within_allowance"] = True
    row["added_on_a_tenth_bytes"] = without["added_bytes"]
    return row


def main(options: Options) -> None:
    if options.measure is not None:
        assert options.folder is not None
        print(json.dumps(measure(options.measure, options.folder, options)))
        return
    from leco_plugin.evaluation.report import describe_code, describe_machine, made_by

    rows, code = [], describe_code()  # before anything is measured
    with tempfile.TemporaryDirectory() as temporary:
        folder = write_photographs(options.folder or Path(temporary) / "full", options)
        tenth = replace(options, width=options.width // 10, height=options.height // 10)
        small = write_photographs(Path(temporary) / "tenth", tenth)
        for way in options.ways:
            row = compared(way, folder, small, options) | made_by(code)
            taken = f"{row['added_bytes'] / 1e6:.0f} MB" if row["within_allowance"] else "over"
            print(f"{way}: {taken}", flush=True)
            rows.append(row)
    results = {
        "format": 1,
        "machine": describe_machine(),
        "photographs": [options.images, options.width, options.height],
        "allowance_bytes": options.allowance,
        "runs": rows,
    }
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(results, indent=2) + "\n")


if __name__ == "__main__":
    main(tyro.cli(Options))
