"""Results as a chart stores them, made up."""

from __future__ import annotations

from typing import Any


def run(name: str, seed: int = 0, psnr: float = 20.0, **figures: Any) -> dict[str, Any]:
    """A run whose curve rises by a decibel in each of the last five of ten seconds."""
    values: dict[str, Any] = {
        "name": name,
        "method": "leco-ngp",
        "sampler": "learned-occupancy",
        "seed": seed,
        "steps": 100,
        "train_seconds": 10.0,
        "step_seconds": 0.1,
        "learn_seconds": 3.0,
        "freeze_seconds": 3.0,
        "psnr": psnr,
        "ssim": 0.5,
        "lpips": None,
        "samples_per_ray": 30.0,
        "field_queries_per_ray": 31.0,
        "proposal_queries_per_ray": 0.0,
        "train_queries": {"field": 1000, "proposal": 0, "learning": 500},
        "render_seconds_per_image": 1.0,
        "peak_memory_bytes": 2 * 10**9,
        "peak_process_bytes": 2 * 10**9,
        "peak_allocator_bytes": None,
        "curve": [[5.0 + i, psnr - 5.0 + i] for i in range(6)],
        "occupancy": None,
    }
    return values | figures


def occupancy(size: int, kept: float, grids: list[dict[str, Any]] | None = None) -> dict[str, Any]:
    """What is stored of an occupancy whose numbers take `size` bytes in bfloat16."""
    return {
        "params": size // 2,
        "bytes": size,
        "learn_seconds": 3.0,
        "empty_fraction": 0.8,
        "image_price_db": 0.01,
        "lost_surface_mass": 1e-4,
        "kept_surface_recall": None,
        "free_space_skipped": None,
        "at_equal_loss": {
            "kept_reached_volume": kept,
            "kept_candidates": kept,
            "grids": grids or [],
            "left_out": [],
        },
    }


def grid(resolution: int, kept: float) -> dict[str, Any]:
    """What is stored of an occupancy grid made from a field."""
    return {
        "resolution": resolution,
        "bytes": resolution**3 // 8,
        "update_seconds": 2.0,
        "kept_reached_volume": kept,
    }


def results(*runs: dict[str, Any], **changes: Any) -> dict[str, Any]:
    """Results around runs."""
    values: dict[str, Any] = {
        "format": 1,
        "machine": {"cores": 2, "threads": 2, "device": "cpu"},
        "scene": {"name": "city"},
        "protocol": {"seconds": 10.0, "steps": None},
        "suite": None,
        "question": None,
        "made": {
            "date": "2024-02-29",
            "command": "leco chart --data city",
            "version": "0.1.0",
            "commit": None,
        },
        "occupancy": None,
        "runs": list(runs),
        "failures": [],
    }
    return values | changes


def slow_front(points: list[tuple[float, float]]) -> set[tuple[float, float]]:
    """Points that no other one matches in both and beats in one."""
    return {
        (cost, gain)
        for cost, gain in points
        if not any(c <= cost and g >= gain and (c < cost or g > gain) for c, g in points)
    }
