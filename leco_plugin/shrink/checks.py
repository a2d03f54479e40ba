"""What `leco shrink` refuses before it works for minutes, each in a line."""

from __future__ import annotations

import math
from pathlib import Path

from leco_plugin.learning.freezing import HARDLY_ANYTHING
from leco_plugin.occupancy import Occupancy
from leco_plugin.shrink.references import LOST_DECISIONS, declared
from leco_plugin.shrink.rungs import Bounds, Ground
from leco_plugin.shrink.sources import Source


def check_bounds(bounds: Bounds) -> None:
    """Whether bounds are numbers that can be kept.

    Raises:
        ValueError: one is out of range.
    """
    if not 0.0 <= bounds.lost_surface_mass < 1.0 or not math.isfinite(bounds.image_price_db):
        raise ValueError(
            f"--lost-surface-mass is from 0 to 1 and --image-price a number of dB, not "
            f"{bounds.lost_surface_mass} and {bounds.image_price_db}"
        )


def check_room(original: Occupancy, bounds: Bounds) -> None:
    """Whether anything is left to lose after what the original declares.

    Raises:
        ValueError: nothing is.
    """
    lost, decisions, price = (
        max(declared(original, name), 0.0)
        for name in ("lost_surface_mass", LOST_DECISIONS, "image_price_db")
    )
    if decisions >= bounds.lost_surface_mass:
        raise ValueError(
            f"the occupancy itself has lost {decisions:.2e} of the decisions, which leaves nothing "
            f"of {bounds.lost_surface_mass:.2e}: raise --lost-surface-mass, or shrink its original"
        )
    if lost >= bounds.lost_surface_mass:
        raise ValueError(
            f"the occupancy itself declares a lost surface mass of {lost:.2e}, which leaves "
            f"nothing of {bounds.lost_surface_mass:.2e}: raise --lost-surface-mass"
        )
    if price >= bounds.image_price_db:
        raise ValueError(
            f"the occupancy itself declares an image price of {price:.3f} dB, which leaves nothing "
            f"of {bounds.image_price_db:.3f} dB: raise --image-price"
        )


def check_march(original: Occupancy, file: Path) -> None:
    """Whether an occupancy says how its rays are marched.

    Raises:
        ValueError: it does not, or not in numbers.
    """
    for name in ("near", "far", "step_size"):
        value = original.report.get(name)
        if not (isinstance(value, int | float) and 0.0 <= value < math.inf):
            raise ValueError(
                f"{file} does not say how its rays are marched: its {name} is {value}, no distance"
            )


def check_skips(original: Occupancy, file: Path) -> None:
    """Whether an occupancy skips enough for a smaller gate to be worth anything.

    Raises:
        ValueError: it skips nothing, or next to nothing of all candidates.
    """
    skipped = original.report.get("empty_fraction")
    if original.threshold == 0.0:
        said = "skips nothing, for its threshold is 0"
    elif isinstance(skipped, int | float) and skipped < HARDLY_ANYTHING:
        said = f"skips {skipped:.1%} of all candidates, next to nothing"
    else:
        return
    raise ValueError(f"{file} {said}: there is nothing to shrink; learn it for more steps")


def check_still_skips(ground: Ground, file: Path) -> None:
    """Whether an original still skips enough at a threshold that was lowered for it.

    Raises:
        ValueError: it skips next to nothing of all candidates.
    """
    kept = float(ground.references[0].search.evidence.kept.double().mean())
    if 1.0 - kept < HARDLY_ANYTHING:
        raise ValueError(
            f"{file} is within these bounds only where it skips {1.0 - kept:.1%} of all "
            "candidates, next to nothing: raise --lost-surface-mass, or learn it for more steps"
        )


def check_known(source: Source, original: Occupancy, file: Path) -> None:
    """Whether what an occupancy has lost can be added to what a field says of a smaller one.

    Raises:
        ValueError: it was shrunk without a field.
    """
    if source.model is not None and LOST_DECISIONS in original.report:
        raise ValueError(
            f"{file} was shrunk without its run, so that nobody knows what it has lost of the "
            "surface mass: shrink its original"
        )
