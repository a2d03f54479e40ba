"""An error of the user can be caught like any other."""

from __future__ import annotations

from leco_plugin.scenes.input_error import InputError, unknown_name


def test_a_notebook_survives_it() -> None:
    assert issubclass(InputError, ValueError) and not issubclass(InputError, SystemExit)


def test_an_unknown_name_is_answered_with_a_known_one_only_where_it_resembles_one() -> None:
    known = ["nerfacto", "BioNeRF"]
    assert unknown_name("method", "bionerv", known) == (
        "there is no method 'bionerv'; did you mean BioNeRF? There are nerfacto, BioNeRF"
    )
    assert unknown_name("case", "x", known) == "there is no case 'x'; there are nerfacto, BioNeRF"
    assert unknown_name("case", "x", []) == "there is no case 'x'; there are none"
