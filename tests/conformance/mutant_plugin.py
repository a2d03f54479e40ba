"""A distribution that holds the mutants, as another package's samplers would be installed."""

from __future__ import annotations

from pathlib import Path

from conformance.estimator_mutants import MUTANTS, Sound
from conformance.proposal_mutants import PROPOSAL_MUTANTS, SoundProposal

from leco_plugin.samplers.registry import GROUP

CLASSES = [
    Sound,
    SoundProposal,
    *(mutant for family in MUTANTS.values() for mutant in family),
    *(mutant for family in PROPOSAL_MUTANTS.values() for mutant in family),
]


def write_distribution(folder: Path, more: str = "") -> Path:
    """Writes what an installer leaves of a package; `folder` is then put on the path.

    Args:
        more: further sections of its entry points.
    """
    info = folder / "mutants-0.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: mutants\nVersion: 0.0\n")
    lines = [f"{kind.__name__} = {kind.__module__}:{kind.__name__.lower()}" for kind in CLASSES]
    (info / "entry_points.txt").write_text("\n".join([f"[{GROUP}]", *lines, "", more, ""]))
    return folder
