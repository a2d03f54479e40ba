"""Which rules apply to a name, and applying them: what the command and the tests share."""

from __future__ import annotations

from collections.abc import Iterator

from leco_plugin.conformance.estimators import EstimatorCase
from leco_plugin.conformance.proposals import ProposalCase
from leco_plugin.conformance.rules import RULES, Case, Rule, Verdict, apply, left_as_before
from leco_plugin.conformance.samplers import SamplerCase
from leco_plugin.conformance.scene import SLAB
from leco_plugin.names import unknown_name
from leco_plugin.samplers.registry import sampler_spec, samplers, why_left_out
from leco_plugin.scenes.input_error import InputError


def sampler_cases(name: str) -> list[Case]:
    """A registered sampler at each seam that it serves.

    Raises:
        ValueError: there is no such sampler, it serves no seam, or it cannot be built.
    """
    spec = sampler_spec(name)
    kinds = ((spec.estimator, EstimatorCase), (spec.proposal, ProposalCase))
    cases: list[SamplerCase] = [kind(name) for builder, kind in kinds if builder is not None]
    if not cases:
        raise ValueError(f"sampler {name!r} builds neither an estimator nor a proposal sampler")
    for case in cases:
        _refuse_what_cannot_be_built(case)
    return [*cases]


def _refuse_what_cannot_be_built(case: SamplerCase) -> None:
    """One line about a builder, instead of one a rule with remedies for something else."""
    try:
        with left_as_before():
            case.build_in(SLAB)
    except (Exception, SystemExit) as error:
        raise ValueError(
            f"the {case.seam} of sampler {case.name!r} cannot be built: {type(error).__name__}: "
            f"{error} (SamplerSpec says what its builder is called with)"
        ) from error


def host_cases(name: str) -> list[Case]:
    """A registered method; an `InputError` where it cannot be built on the scene of the kit, or not
    be guided."""
    # not above: samplers are checked without nerfstudio's models
    from leco_plugin.conformance import host_images, host_training  # noqa: F401 (register checks)
    from leco_plugin.conformance.hosts import HostCase

    case = HostCase(name)
    try:
        case.shared()
    except InputError:
        raise
    except Exception as error:
        said = f"{type(error).__name__}: {error}"
        raise InputError(f"{name} cannot be built on the scene of the kit: {said}") from error
    return [case]


def cases_of(name: str) -> list[Case]:
    """A sampler or a method; of a name that is both, the sampler. `ValueError` for neither."""
    known = samplers()
    if ":" in name or name in known or why_left_out(name) is not None:
        return sampler_cases(name)
    from nerfstudio.configs.method_configs import all_methods

    if name not in all_methods:
        raise ValueError(unknown_name("sampler or method", name, [*sorted(known), *all_methods]))
    return host_cases(name)


def pairs(cases: list[Case]) -> list[tuple[Rule, Case]]:
    """Each rule with each case at whose seam it has something to check."""
    return [(rule, case) for case in cases for rule in RULES if case.seam in rule.checks]


def check(name: str) -> Iterator[Verdict]:
    """Applies the rules for a sampler or a method one by one; errors of `cases_of` come at once."""
    return (apply(rule, case) for rule, case in pairs(cases_of(name)))
