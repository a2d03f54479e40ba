"""A distribution that holds the mutants, installed as another package's would be."""

from __future__ import annotations

from pathlib import Path

from conformance import batch_mutants, host_mutants
from conformance.estimator_mutants import MUTANTS, Sound
from conformance.proposal_mutants import PROPOSAL_MUTANTS, SoundProposal

from leco_plugin.hosts import seams
from leco_plugin.samplers import registry

CLASSES = [
    Sound,
    SoundProposal,
    *(mutant for family in MUTANTS.values() for mutant in family),
    *(mutant for family in batch_mutants.MUTANTS.values() for mutant in family),
    *(mutant for family in PROPOSAL_MUTANTS.values() for mutant in family),
]
HOSTS = host_mutants.__name__
ENTRIES = {
    registry.GROUP: [
        *(f"{kind.__name__} = {kind.__module__}:{kind.__name__.lower()}" for kind in CLASSES),
        *(f"{name} = {HOSTS}:{name.lower()}" for name in host_mutants.SAMPLERS),
    ],
    "nerfstudio.method_configs": [
        f"{name} = {HOSTS}:{name.lower()}" for name in host_mutants.METHODS
    ],
    seams.GROUP: [f"{name} = {HOSTS}:{name}" for name in host_mutants.ADAPTERS],
}


def write_distribution(folder: Path, more: str = "") -> Path:
    """Writes what an installer leaves of a package; `folder` is then put on the path.

    Args:
        more: further sections of its entry points.
    """
    info = folder / "mutants-0.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: mutants\nVersion: 0.0\n")
    lines = [line for group, found in ENTRIES.items() for line in (f"[{group}]", *found)]
    (info / "entry_points.txt").write_text("\n".join([*lines, "", more, ""]))
    return folder
