"""Claims about the rule by which sizes follow the scene."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from leco_plugin.models.sizing import scene_sizes
from leco_plugin.models.sizing.scene_sizes import choose, complete
from leco_plugin.models.sizing.sizes import (
    AUTOMATIC,
    BYTES_PER_VALUE,
    CHOSEN,
    LARGE,
    MOST_LEFT_BEHIND,
    PAPER,
    SMALL,
    Sizes,
    automatic,
    learning_only,
    left_open,
    size_at,
    values_of,
    with_size,
)
from leco_plugin.scenes.bounds import BoundsConfig
from leco_plugin.scenes.city.cameras import CaptureConfig
from leco_plugin.scenes.city.city import CityConfig
from leco_plugin.scenes.city.folder import write_city
from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.photographs import LecoPhotographsDataParserConfig
from leco_plugin.scenes.survey import CAMERAS, SceneDetail, detail_of, points_in

IMAGES = 20
TABLE = "field.encoding.log2_table"

few = settings(max_examples=25, deadline=None)
"""Each example builds modules to count their values."""

devices = st.sampled_from([SMALL, LARGE])
texels = st.floats(1.0, 1e9)
across = st.floats(1.0, 1e5)


def scene(texels: float, across: float) -> SceneDetail:
    return SceneDetail(IMAGES, round(8 * texels), texels, across)


def chosen(most: Sizes, detail: SceneDetail | None, memory: int | None = None) -> Sizes:
    return choose(automatic(most), most, detail, IMAGES, memory).sizes


@few
@given(most=devices, texels=texels, across=across, more=st.floats(1.0, 100.0))
def test_no_size_is_smaller_for_a_larger_scene(
    most: Sizes, texels: float, across: float, more: float
) -> None:
    small = chosen(most, scene(texels, across))
    for larger in (scene(texels * more, across), scene(texels, across * more)):
        large = chosen(most, larger)
        assert all(size_at(large, path) >= size_at(small, path) for path in CHOSEN)
        assert values_of(large, IMAGES) >= values_of(small, IMAGES)


@few
@given(most=devices, texels=texels, across=across)
def test_sizes_are_complete_and_never_beyond_those_of_the_device(
    most: Sizes, texels: float, across: float
) -> None:
    sizes = chosen(most, scene(texels, across))
    assert not left_open(sizes)
    assert all(0 < size_at(sizes, path) <= size_at(most, path) for path in CHOSEN)
    assert sizes.gate.scene_experts == sizes.field.experts.scene_experts
    assert replace(sizes, gate=most.gate, field=most.field) == most  # nothing else is touched


@pytest.mark.parametrize("most", [SMALL, LARGE])
def test_a_scene_without_end_and_one_that_is_not_known_have_the_sizes_of_the_device(
    most: Sizes,
) -> None:
    assert chosen(most, scene(1e12, 1e9)) == most
    assert chosen(most, None) == most


def test_the_table_follows_the_surface_and_the_cells_its_side() -> None:
    sizes = [chosen(LARGE, scene(3e3 * 4**k, 128 * 2**k)) for k in range(4)]
    assert [size_at(each, TABLE) for each in sizes] == [13, 15, 17, 19]  # 7,500 entries first
    assert [each.field.encoding.finest for each in sizes] == [128, 256, 512, 1024]
    octaves = [each.gate.encoding.octaves for each in sizes]
    assert octaves == [octaves[0] + k for k in range(4)]


def test_experts_follow_millions_of_texels_and_their_width_follows_few() -> None:
    numbers = {1e5: (1, 1), 2.0**20: (1, 1), 1.5e6: (2, 2), 3e6: (3, 3), 1e7: (4, 8)}
    for texels, expected in numbers.items():
        found = [chosen(most, scene(texels, 4000.0)).field.experts for most in (SMALL, LARGE)]
        assert tuple(each.scene_experts for each in found) == expected
        assert [each.width for each in found] == [64, 128]
    narrow = chosen(SMALL, scene(2.0**14, 4000.0)).field.experts
    assert (narrow.scene_experts, narrow.width) == (1, 32)


@few
@given(
    path=st.sampled_from(CHOSEN),
    value=st.integers(1, 14),
    texels=texels,
    across=across,
)
def test_what_is_set_by_hand_stays(path: str, value: int, texels: float, across: float) -> None:
    value = 16 * value if path.endswith(("width", "finest")) else value
    wanted = with_size(automatic(SMALL), path, value)
    if path == "gate.scene_experts":  # more than the field has would be refused
        wanted = with_size(wanted, "field.experts.scene_experts", value)
    made = choose(wanted, SMALL, scene(texels, across), IMAGES)
    assert size_at(made.sizes, path) == value
    name = {"scene_experts": "scene experts", "log2_table": "hash table"}
    if path.startswith("field.experts.scene") or path == TABLE:
        line = next(line for line in made.lines if name[path.split(".")[-1]] in line)
        assert "set by hand" in line


def test_what_follows_from_a_size_follows_from_the_one_that_is_set() -> None:
    wanted = with_size(automatic(SMALL), "field.experts.scene_experts", 3)
    assert chosen_from(wanted).gate.scene_experts == 3
    wanted = with_size(automatic(SMALL), "gate.scene_experts", 2)
    assert chosen_from(wanted).field.experts.scene_experts == 2
    coarse = chosen_from(with_size(automatic(SMALL), "field.encoding.finest", 64))
    assert coarse.field.encoding.levels < SMALL.field.encoding.levels
    assert coarse.gate.encoding.octaves < SMALL.gate.encoding.octaves
    few = chosen_from(with_size(automatic(SMALL), "gate.encoding.octaves", 2))
    assert few.gate.width < SMALL.gate.width


def test_experts_that_follow_the_gate_do_not_claim_to_follow_texels() -> None:
    wanted = with_size(automatic(SMALL), "gate.scene_experts", 3)
    lines = choose(wanted, SMALL, scene(5e4, 4000.0), IMAGES).lines
    (line,) = (line for line in lines if "scene experts" in line)
    assert "the gate's" in line and "texels" not in line


def test_a_field_that_is_left_behind_has_a_smaller_table_and_never_a_larger_one() -> None:
    few, many = scene(5e3, 4000.0), scene(1e7, 4000.0)
    first, alone = learning_only(automatic(SMALL)), automatic(SMALL)
    most = MOST_LEFT_BEHIND[TABLE]
    for seen, table in ((few, size_at(chosen(SMALL, few), TABLE)), (many, most)):
        assert size_at(choose(first, SMALL, seen, IMAGES).sizes, TABLE) == table
    assert size_at(choose(alone, SMALL, many, IMAGES).sizes, TABLE) > most
    assert size_at(learning_only(SMALL), TABLE) == most
    small = with_size(SMALL, TABLE, 12)
    assert size_at(learning_only(small), TABLE) == 12


@pytest.mark.parametrize("most", [SMALL, LARGE], ids=["SMALL", "LARGE"])
def test_a_field_that_is_left_behind_has_one_scene_expert_unless_set_by_hand(most: Sizes) -> None:
    many = scene(1e8, 4000.0)
    made = choose(learning_only(automatic(most)), most, many, IMAGES)
    assert made.sizes.gate.scene_experts == made.sizes.field.experts.scene_experts == 1
    assert learning_only(most).gate.scene_experts == 1
    told = [line for line in made.lines if "hash table" in line or "scene experts" in line]
    assert len(told) == 2
    for line in told:
        assert "only learns an occupancy" in line and "by hand" not in line
    by_hand = with_size(learning_only(automatic(most)), "field.experts.scene_experts", 3)
    assert choose(by_hand, most, many, IMAGES).sizes.gate.scene_experts == 3


def chosen_from(wanted: Sizes) -> Sizes:
    return choose(wanted, SMALL, scene(1e7, 4000.0), IMAGES).sizes


@pytest.mark.parametrize("sizes", [SMALL, LARGE, PAPER])
def test_complete_sizes_are_left_alone_and_nothing_is_said(sizes: Sizes) -> None:
    made = choose(sizes, SMALL, None, IMAGES)
    assert made.sizes == sizes and made.lines == ()


def test_the_log_has_a_line_for_each_size_with_its_reason() -> None:
    made = choose(automatic(SMALL), SMALL, scene(4000.0, 100.0), IMAGES)
    assert "4,000 texels" in made.lines[0] and f"{IMAGES} photographs" in made.lines[0]
    sizes, text = made.sizes, "\n".join(made.lines)
    assert f"2^{size_at(sizes, TABLE)} " in text and "texels" in text
    for name in ("finest cells", "levels", "scene experts", "expert width", "gate octaves"):
        assert sum(name in line.split("  ")[1] for line in made.lines[1:] if "  " in line) == 1
    assert f"{values_of(sizes, IMAGES):,} parameters" in made.lines[-1]
    assert "the most on this device" not in text
    assert "the most on this device" in "\n".join(
        choose(automatic(SMALL), SMALL, scene(1e9, 1e5), IMAGES).lines
    )
    assert "nothing is known" in choose(automatic(SMALL), SMALL, None, IMAGES).lines[0]


@few
@given(memory=st.integers(0, 40).map(lambda power: 2**power), texels=texels)
def test_a_chosen_table_leaves_the_memory_to_others(memory: int, texels: float) -> None:
    free = chosen(LARGE, scene(texels, 4000.0))
    try:
        sizes = chosen(LARGE, scene(texels, 4000.0), memory)
    except ValueError as error:
        assert "the device has" in str(error) and "\n" not in str(error)
        assert memory < 2**27
        return
    used = BYTES_PER_VALUE * values_of(sizes, IMAGES)
    fits = used <= memory * scene_sizes.SHARE_OF_MEMORY
    assert fits or size_at(sizes, TABLE) == scene_sizes.FEWEST_ENTRIES
    if BYTES_PER_VALUE * values_of(free, IMAGES) <= memory * scene_sizes.SHARE_OF_MEMORY:
        assert sizes == free


def test_a_table_that_memory_made_smaller_says_so() -> None:
    made = choose(automatic(LARGE), LARGE, scene(1e9, 1e5), IMAGES, memory=1 << 30)
    assert size_at(made.sizes, TABLE) < size_at(LARGE, TABLE)
    (line,) = (line for line in made.lines if "hash table" in line)
    assert "memory" in line and "texels" not in line


def changed(path: str, value: int) -> Sizes:
    return with_size(automatic(SMALL), path, value)


@pytest.mark.parametrize(
    ("wanted", "says"),
    [
        (changed("field.experts.width", -1), "the field's width is -1"),
        (changed("gate.width", -1), "the gate's width is -1"),
        (changed("field.encoding.log2_table", 29), "the field's log2_table is 29"),
        (changed("field.encoding.finest", 8), "raise .*finest"),
        (
            with_size(changed("field.encoding.log2_table", 28), "field.encoding.levels", 12),
            "more than rows can be numbered",
        ),
        (
            with_size(changed("gate.scene_experts", 4), "field.experts.scene_experts", 2),
            "to 4 scene experts and the field has 2",
        ),
        (changed("candidates", 0), "candidates is 0"),
        (changed("field.encoding.log2_table", 27), "takes .* GB .*log2-table"),
        (
            with_size(changed("field.encoding.kind", "grid"), "field.encoding.plane_cells", 1024),
            "takes .* GB .*plane-cells",
        ),
    ],
)
def test_sizes_that_cannot_be_are_refused_in_one_line(wanted: Sizes, says: str) -> None:
    with pytest.raises(ValueError, match=says) as caught:
        choose(wanted, SMALL, scene(1e5, 500.0), IMAGES, memory=8 << 30)
    assert "\n" not in str(caught.value)


def test_a_model_asks_its_scene_only_where_a_size_is_open(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[Any] = []

    def detail(*arguments: Any) -> SceneDetail:
        asked.append(arguments)
        return scene(5000.0, 200.0)

    monkeypatch.setattr(scene_sizes, "detail_of", detail)
    metadata = {CAMERAS: "cameras"}
    assert complete(SMALL, BoundsConfig(), metadata, IMAGES, "cpu") == SMALL
    assert not asked and capsys.readouterr().out == ""
    sizes = complete(automatic(SMALL), BoundsConfig(), metadata, IMAGES, "cpu")
    assert len(asked) == 1 and size_at(sizes, TABLE) < size_at(SMALL, TABLE)
    assert "5,000 texels" in capsys.readouterr().out
    assert complete(automatic(SMALL), BoundsConfig(), {}, IMAGES, "cpu") == SMALL
    assert "nothing is known of the scene" in capsys.readouterr().out


def test_a_wrong_size_ends_a_command_with_one_line() -> None:
    with pytest.raises(InputError, match="the gate's width is -3"):
        complete(changed("gate.width", -3), BoundsConfig(), {}, IMAGES, "cpu")


def city(folder: Path, blocks: int) -> tuple[SceneDetail, int]:
    """Detail of a drone survey of a city, and its number of photographs."""
    capture = CaptureConfig(12, 9, street_per_block=0.0)
    write_city(CityConfig(blocks), folder, capture)
    parser = LecoPhotographsDataParserConfig(data=folder, downscale_factor=1)
    outputs = parser.setup().get_dataparser_outputs("train")
    outputs.cameras.rescale_output_resolution(160 / 12)  # the poses are the same at every size
    found = detail_of(outputs.cameras, points_in(outputs.metadata))
    return found, len(outputs.image_filenames)


@pytest.mark.slow
def test_a_block_has_a_quarter_of_the_parameters_of_eight_by_eight(tmp_path: Path) -> None:
    values, tables, experts = {}, [], []
    for blocks in (1, 3, 8):
        found, images = city(tmp_path / str(blocks), blocks)
        sizes = choose(automatic(SMALL), SMALL, found, images).sizes
        values[blocks] = values_of(sizes, images)
        tables.append(size_at(sizes, TABLE))
        experts.append(sizes.field.experts.scene_experts)
        assert sizes.gate.scene_experts == experts[-1]
        sizes = with_size(sizes, "field.experts.scene_experts", SMALL.field.experts.scene_experts)
        sizes = with_size(sizes, "gate.scene_experts", SMALL.gate.scene_experts)
        assert sizes == SMALL or blocks < 8
    assert tables == [17, 19, 19]
    assert experts == [1, 1, 1]
    assert values[1] <= values[8] / 4


def test_zero_stands_for_automatic() -> None:
    assert AUTOMATIC == 0 and set(left_open(automatic(SMALL))) == set(CHOSEN)
    assert left_open(SMALL) == left_open(LARGE) == left_open(PAPER) == []
