"""Claims about names of options, and what is said of an unknown name."""

from __future__ import annotations

from leco_plugin.names import options_in, unknown_name


def test_an_unknown_name_is_answered_with_a_known_one_only_where_it_resembles_one() -> None:
    known = ["nerfacto", "BioNeRF"]
    assert unknown_name("method", "bionerv", known) == (
        "there is no method 'bionerv'; did you mean BioNeRF? There are nerfacto, BioNeRF"
    )
    assert unknown_name("case", "x", known) == "there is no case 'x'; there are nerfacto, BioNeRF"
    assert unknown_name("case", "x", []) == "there is no case 'x'; there are none"


def test_options_are_named_as_help_has_them_whatever_way_they_were_typed() -> None:
    words = ["leco-ngp", "--load_dir", "a-b", "--max-num-iterations=9", "--", "-h", "--steps", "-1"]
    assert options_in(words) == ["--load-dir", "--max-num-iterations", "--steps"]
    assert options_in([]) == []
