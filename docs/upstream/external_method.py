"""The entry of this package in nerfstudio/configs/external_methods.py, below the import.

To be proposed with `leco_nerf.md` as docs/nerfology/methods/leco_nerf.md, and a line for it in the
lists of docs/nerfology/methods/index.md and docs/index.md. `tests/test_upstream.py` tries all.
"""

from nerfstudio.configs.external_methods import ExternalMethod, external_methods

# LeCO-NeRF
external_methods.append(
    ExternalMethod(
        """[bold yellow]LeCO-NeRF[/bold yellow]
For more information visit: https://docs.nerf.studio/nerfology/methods/leco_nerf.html

To enable LeCO-NeRF, you must install it first by running:
  [grey]pip install leco-plugin[/grey]""",
        configurations=[
            (
                "leco-occupancy",
                "Learned occupancy: learn it, freeze and calibrate it, go on guided by it.",
            ),
            (
                "leco-occupancy-paper",
                "The same in the sizes of the paper (8 experts of 7 x 256, 257 samples); for its "
                "losses too, --pipeline.model.gate-loss.form paper.",
            ),
            (
                "leco-ngp",
                "Instant-NGP, guided by learned occupancy instead of its occupancy grid.",
            ),
            (
                "leco-nerfacto",
                "Nerfacto, guided by learned occupancy instead of its proposal networks.",
            ),
            (
                "leco-switch-nerf",
                "Switch-NeRF, guided by learned occupancy instead of coarse and fine samples.",
            ),
            (
                "leco-mega-nerf",
                "Mega-NeRF's fixed shares of the ground, guided by learned occupancy.",
            ),
            (
                "switch-nerf",
                "Switch-NeRF, unguided: coarse and fine samples, a gate among equal experts.",
            ),
        ],
        pip_package="leco-plugin",
    )
)
