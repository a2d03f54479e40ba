"""Claims about folders that one process at a time may fill."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.locks import alone_in


def test_a_folder_that_cannot_be_written_is_named_with_the_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(path: Path, *_: int) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    def refused(name: str, why: str) -> None:
        line = rf"into .*{name} \({why}\): name another folder with --out$"
        with pytest.raises(InputError, match=line), alone_in(tmp_path / name, "scene"):
            raise AssertionError

    (tmp_path / "file").touch()
    refused("file", "File exists")
    refused("file/scene", "Not a directory")
    monkeypatch.setattr(os, "open", refuse)
    refused("read_only", "Permission denied")
