"""An error of the user can be caught like any other."""

from __future__ import annotations

from leco_plugin.scenes.input_error import InputError


def test_a_notebook_survives_it() -> None:
    assert issubclass(InputError, ValueError) and not issubclass(InputError, SystemExit)
