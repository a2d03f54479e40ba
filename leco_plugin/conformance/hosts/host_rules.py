"""The rules for guided hosts: what users of a method rely on, why, and what to do about it."""

from __future__ import annotations

from leco_plugin.conformance.hosts import host_images, host_life, host_training
from leco_plugin.conformance.hosts.host_case import HostCase
from leco_plugin.conformance.rule import Rule

HOST = HostCase.seam

HOST_RULES = (
    Rule(
        name="outputs-can-be-drawn",
        reason="ns-render, ns-eval and the viewer draw every output of a model, and end with an "
        "exception at one that they cannot draw.",
        remedy="return rgb [n_rays, 3], depth and accumulation [n_rays, 1] of the type and on the "
        "device of the rays, and other outputs with one channel of floats, or with three or more.",
        checks={HOST: host_images.outputs_can_be_drawn},
    ),
    Rule(
        name="same-image-in-eval",
        reason="a test image must not change from one rendering to the next, nor a figure with it.",
        remedy="draw random numbers (noise, jitter, backgrounds) only while self.training is set, "
        "in the host and in its sampler.",
        checks={HOST: host_images.same_image_in_eval},
    ),
    Rule(
        name="samples-shift-in-training",
        reason="a field that is always asked at the same places learns bands between them.",
        remedy="keep the sampler a submodule of the host, so that it is in training when the host "
        "is; let it shift each ray's samples, and leave them where it puts them.",
        checks={HOST: host_training.samples_shift_in_training},
    ),
    Rule(
        name="teaches-the-host-alone",
        reason="a host whose field gets no gradient learns nothing; a gate that gets one, or that "
        "an optimizer decays, no longer is the occupancy whose price was measured.",
        remedy="sample under torch.no_grad as a context, shade outside of it, and leave "
        "self.leco_guide out of get_param_groups and of requires_grad_.",
        checks={HOST: host_training.teaches_the_host_alone},
    ),
    Rule(
        name="nothing-superfluous-is-left",
        reason="grids and proposal networks that nobody asks any more take memory, make "
        "checkpoints large, and slow down each step of an optimizer and of data-parallel training.",
        remedy="have the HostAdapter remove what the guide stands for from the host; hold "
        "proposal densities in a list of bound methods, which the built-in adapter finds.",
        checks={HOST: host_training.nothing_superfluous_is_left},
    ),
    Rule(
        name="shades-only-what-is-kept",
        reason="what is shaded where all is empty is time lost, and a ray that is not shaded where "
        "something is has a hole; both happen when host and occupancy differ in coordinates.",
        remedy="ask the field about the samples that the sampler returns and no others, in the "
        "coordinates of the rays that the sampler was given.",
        checks={HOST: host_images.shades_only_what_is_kept},
    ),
    Rule(
        name="state-and-yaml-round-trip",
        reason="ns-eval, ns-render and the viewer open a run by its config.yml and checkpoint; the "
        "occupancy's file may be gone by then.",
        remedy="keep in the config what YAML can say (no lambdas and no open objects), and in "
        "parameters or buffers all that decides how the model renders.",
        checks={HOST: host_life.state_and_yaml_round_trip},
    ),
    Rule(
        name="empty-rays-show-background",
        reason="an occupancy leaves rays into the sky without samples, and sometimes a whole "
        "batch: that must neither end the run nor leave light or NaN in images and weights.",
        remedy="give rays without samples accumulation 0 and the background's colour, divide by no "
        "sum of weights without a bound, and keep the loss connected to the field (packed); "
        "shade what the sampler returns all the same (fixed number of samples).",
        checks={HOST: host_images.empty_rays_show_background},
    ),
    Rule(
        name="guided-by-everything-is-dense",
        reason="guidance that changes more than what is skipped changes the image, and no "
        "calibration has measured that.",
        remedy="let the sampler leave candidates out and move none, hand out all that it keeps, "
        "and cover each ray from its near to its far end where everything is occupied.",
        checks={HOST: host_images.guided_by_everything_is_dense},
    ),
    Rule(
        name="resumes-where-it-stopped",
        reason="long runs are interrupted, and go on from a checkpoint with what it holds alone.",
        remedy="keep what a step depends on in parameters, buffers or extra state, or derive it "
        "in update_to_step, which nerfstudio calls before it loads the state.",
        checks={HOST: host_life.resumes_where_it_stopped},
    ),
    Rule(
        name="two-processes-step-alike",
        reason="data-parallel training averages the ranks' gradients: a host that does something "
        "else on one of them learns another scene with --machine.num-devices 2, or hangs.",
        remedy="make the loss a mean over rays, let nothing depend on the rank, hold no buffers "
        "of types that ranks cannot send (int16).",
        checks={HOST: host_life.two_processes_step_alike},
    ),
)
