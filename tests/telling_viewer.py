"""`ns-viewer`, which says when it has set up the scene. A script for `ForkedCommands`."""

from __future__ import annotations

import sys
from typing import Any

from nerfstudio.scripts.viewer import run_viewer

READY = "the scene is set up"


class TellingViewer(run_viewer.ViewerState):
    """nerfstudio's viewer."""

    def update_scene(self, *arguments: Any, **options: Any) -> None:
        super().update_scene(*arguments, **options)
        print(READY, flush=True)


if __name__ == "__main__":
    run_viewer.ViewerState = TellingViewer
    sys.argv[0] = "ns-viewer"
    run_viewer.entrypoint()
