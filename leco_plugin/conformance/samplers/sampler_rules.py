"""The rules for samplers: what hosts rely on, why, and what to do when it does not hold."""

from __future__ import annotations

from leco_plugin.conformance.rule import Rule
from leco_plugin.conformance.samplers import (
    estimator_choices,
    estimator_form,
    proposal_checks,
    sampler_life,
)
from leco_plugin.conformance.samplers.estimator_case import EstimatorCase
from leco_plugin.conformance.samplers.proposal_case import ProposalCase

ESTIMATOR, PROPOSAL = EstimatorCase.seam, ProposalCase.seam

SAMPLER_RULES = (
    Rule(
        name="signature",
        reason="hosts pass these arguments by name and by position, and know nothing else.",
        remedy="take the arguments of nerfacc's OccGridEstimator in its order with its defaults "
        "(estimator); subclass nerfstudio's Sampler, with set_anneal and step_cb, and count "
        "density_fns but call none where an occupancy decides (proposal).",
        checks={ESTIMATOR: estimator_form.signature, PROPOSAL: proposal_checks.signature},
    ),
    Rule(
        name="shapes-types-devices",
        reason="a host indexes its rays with what it gets, and multiplies it with its densities.",
        remedy="make every tensor from those of the rays (new_zeros, to), never with a device or "
        "type of its own; one length for all packed tensors, one number of samples for all rays.",
        checks={
            ESTIMATOR: estimator_form.shapes_types_devices,
            PROPOSAL: proposal_checks.shapes_types_devices,
        },
    ),
    Rule(
        name="sorted-disjoint-inside",
        reason="transmittance is a running product from near to far: out of order, overlapping or "
        "outside, it counts matter twice or where there is none.",
        remedy="hand out intervals from near to far, each begun where the last one ended or later, "
        "with middles between t_min or near_plane and t_max or far_plane, whichever is narrower.",
        checks={
            ESTIMATOR: estimator_form.sorted_disjoint_inside,
            PROPOSAL: proposal_checks.sorted_disjoint_inside,
        },
    ),
    Rule(
        name="packing-consistent",
        reason="packed scans take the samples of a ray to lie together, in the order of the rays.",
        remedy="return int64 ray_indices that never fall and lie in [0, n_rays); sort by ray when "
        "samples are collected in pieces, and add the offset of each piece of rays.",
        checks={ESTIMATOR: estimator_form.packing_consistent},
    ),
    Rule(
        name="deterministic-in-eval",
        reason="a test image must not change from one rendering to the next, nor a figure with it.",
        remedy="draw random numbers only when stratified is set (estimator) or self.training is "
        "(proposal).",
        checks={
            ESTIMATOR: sampler_life.deterministic_in_eval,
            PROPOSAL: sampler_life.deterministic_in_eval,
        },
    ),
    Rule(
        name="stratified-in-training",
        reason="a field that is always asked at the same places learns bands between them.",
        remedy="shift each ray's samples by a random share of a step when stratified is set "
        "(estimator) or self.training is (proposal), and keep them between near and far.",
        checks={
            ESTIMATOR: sampler_life.stratified_in_training,
            PROPOSAL: sampler_life.stratified_in_training,
        },
    ),
    Rule(
        name="skips-only-what-it-may",
        reason="what is skipped though it is occupied is a hole in the image, and what is kept "
        "though it is empty is time lost.",
        remedy="decide by Occupancy.occupied at the middle of each candidate, origin + t direction "
        "whatever the direction's length (the occupancy maps positions itself), in training as in "
        "evaluation; take frame=, and ask at positions that it has moved (proposal).",
        checks={
            ESTIMATOR: estimator_choices.skips_only_what_it_may,
            PROPOSAL: proposal_checks.skips_only_what_it_may,
        },
    ),
    Rule(
        name="all-kept-equals-dense",
        reason="a sampler that changes more than what is skipped cannot be compared with the "
        "one that it replaces.",
        remedy="march from t_min in steps of render_step_size, or of cone_angle times the distance "
        "where that is longer, leave candidates out and move none (estimator); draw from a "
        "histogram without preferring one end of the ray (proposal).",
        checks={
            ESTIMATOR: estimator_choices.all_kept_equals_dense,
            PROPOSAL: proposal_checks.all_kept_equals_dense,
        },
    ),
    Rule(
        name="no-gradient-to-the-gate",
        reason="the occupancy is frozen: its threshold was calibrated for the weights it has; and "
        "the field of the host must go on learning.",
        remedy="sample under torch.no_grad as a context, not by switching gradients off, and leave "
        "requires_grad of the gate as it is.",
        checks={
            ESTIMATOR: sampler_life.no_gradient_to_the_gate,
            PROPOSAL: sampler_life.no_gradient_to_the_gate,
        },
    ),
    Rule(
        name="zero-samples-well-formed",
        reason="rays into the sky have no samples; a batch of them must show the background and "
        "leave finite gradients, not end the run.",
        remedy="return three empty tensors of the usual types, and no stand-in sample (estimator); "
        "return the usual number of samples with finite weights (proposal).",
        checks={
            ESTIMATOR: estimator_form.zero_samples_well_formed,
            PROPOSAL: proposal_checks.zero_samples_well_formed,
        },
    ),
    Rule(
        name="visibility-pruning",
        reason="hosts pass sigma_fn to shade only what light reaches and what shows; a visible "
        "sample that is dropped is missing from the image and learns nothing.",
        remedy="drop a sample when its transmittance is below early_stop_eps or its opacity below "
        "alpha_thre, both as given but for one thing: where opacities are low throughout, "
        "alpha_thre may be lowered, to no less than a tenth of their mean; with 0 for a limit, "
        "drop nothing for it.",
        checks={ESTIMATOR: estimator_choices.visibility_pruning},
    ),
    Rule(
        name="update-while-frozen-is-harmless",
        reason="hosts call update_every_n_steps (estimator), or set_anneal and step_cb (proposal), "
        "in every step, whatever the sampler is.",
        remedy="accept every form of these calls; where an occupancy decides, do nothing.",
        checks={
            ESTIMATOR: estimator_choices.update_while_frozen_is_harmless,
            PROPOSAL: proposal_checks.update_while_frozen_is_harmless,
        },
    ),
    Rule(
        name="state-dict-round-trip",
        reason="a checkpoint is loaded into a sampler that was built from the configuration, with "
        "whatever occupancy that file holds by then; the checkpoint decides.",
        remedy="keep what decides in parameters or buffers whose shapes do not depend on their "
        "values, and make anew what was derived from them when a state dict is loaded.",
        checks={
            ESTIMATOR: sampler_life.state_dict_round_trip,
            PROPOSAL: sampler_life.state_dict_round_trip,
        },
    ),
    Rule(
        name="two-processes",
        reason="ranks that train side by side average their gradients: with other samples on each "
        "they learn different scenes, and a call that one rank leaves out hangs all.",
        remedy="keep what decides in buffers, which ranks share, of types that they can send (not "
        "int16); decide by nothing that belongs to a process (its number, its random numbers).",
        checks={
            ESTIMATOR: sampler_life.two_processes,
            PROPOSAL: sampler_life.two_processes,
        },
    ),
)
