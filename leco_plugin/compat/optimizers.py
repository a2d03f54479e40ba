"""nerfstudio's optimizers beside a model that may lose parameters while it trains."""

from __future__ import annotations

from typing import Any

from nerfstudio.engine.optimizers import Optimizers
from torch.nn import Parameter

from leco_plugin.compat.run_sizes import check_photographs


class OptimizersOfThePresent(Optimizers):
    """They are made before a checkpoint is loaded, and loaded after the model.

    Args:
        config: of each parameter group.
        pipeline: says which parameters there are.
    """

    def __init__(self, config: dict[str, Any], pipeline: Any) -> None:
        super().__init__(config, pipeline.get_param_groups())
        self.pipeline = pipeline

    def load_optimizers(self, loaded_state: dict[str, Any]) -> None:
        """As nerfstudio's, for the parameters that the model has now.

        Raises:
            InputError: the model came back with other photographs than the scene has.
        """
        check_photographs(self.pipeline)
        forget_the_gone(self, self.pipeline.get_param_groups())
        super().load_optimizers(loaded_state)


def forget_the_gone(optimizers: Optimizers, groups: dict[str, list[Parameter]]) -> None:
    """Has optimizers forget the parameters that a model no longer has, with all they remember.

    Args:
        groups: parameters that there are, by the names of the optimizers; others stay as they are.
    """
    for name, parameters in groups.items():
        optimizer, there = optimizers.optimizers[name], {id(p) for p in parameters}
        # in place: others hold on to the same groups
        for held in (*(g["params"] for g in optimizer.param_groups), optimizers.parameters[name]):
            held[:] = [parameter for parameter in held if id(parameter) in there]
        for parameter in [known for known in optimizer.state if id(known) not in there]:
            del optimizer.state[parameter]
