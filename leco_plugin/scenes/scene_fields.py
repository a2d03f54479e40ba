"""Fields of a transforms.json that are not used: said in one line, never dropped in silence."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.markup import escape

from leco_plugin.log import say
from leco_plugin.scenes.lenses import LENS_FIELDS

READ = LENS_FIELDS | {
    "applied_scale",
    "applied_transform",
    "file_path",
    "frames",
    "has_mask",
    "mask_path",
    "metres_per_unit",
    "orientation_override",
    "ply_file_path",
    "test_filenames",
    "test_frames",
    "train_filenames",
    "transform_matrix",
    "transform_matrix_end",
    "transform_matrix_start",
    "val_filenames",
}
"""By leco's own reader, or held against what another reader has made of them."""
NEEDLESS = {
    "aabb",
    "aabb_scale",
    "blur_score",
    "colmap_im_id",
    "colmap_image_id",
    "depth_file_path",
    "depth_path",
    "depth_unit_scale_factor",
    "enable_depth_loading",
    "enable_ray_loading",
    "importance_sampling",
    "integer_depth_scale",
    "n_extra_learnable_dims",
    "offset",
    "render_aabb",
    "scale",
    "sharpness",
    "timestamp",
}
"""Neither geometry nor colour depends on them: our bounds come from cameras and points, and our
methods learn without depths."""


def unused_fields(meta: dict[str, Any]) -> list[str]:
    """Names of fields of a scene and of its frames that are not used and say something."""
    owners = [meta, *meta["frames"], *meta.get("test_frames", [])]
    names = {
        name
        for owner in owners
        for name, value in owner.items()
        if value not in (None, False, 0, "", [], {})
    }
    return sorted(names - READ - NEEDLESS)


def say_unused(meta: dict[str, Any], file: Path) -> None:
    """One line in the log for what a scene says, or has beside it, that is not used."""
    unused = unused_fields(meta)
    folder = (file.parent / str(meta["frames"][0]["file_path"])).parent
    beside = ("dynamic_mask_*", "rays_*.dat", "*.alpha.*")
    unused += [kind for kind in beside if any(folder.glob(kind))]
    if unused:
        say(f"{escape(str(file))}: not used: {escape(', '.join(unused)[:300])}")
