"""Writes `docs/commands.md`, `docs/options.md`, `docs/gifts.md` and the rules of
`docs/conformance.md` from the code itself.

python benchmarks/reference_pages.py
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import re
import sys
import textwrap
from collections.abc import Callable, Collection, Iterator
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

import checkout  # noqa: F401
import gifts_page
import tyro
from page_parts import ROOT, between, table

from leco_plugin.cli import COMMANDS
from leco_plugin.conformance import host_training  # noqa: F401 (registers the checks of hosts)
from leco_plugin.conformance.cases import RULES
from leco_plugin.host_configs import leco_ngp, leco_switch_nerf
from leco_plugin.method_configs import leco_occupancy
from leco_plugin.scenes.city_dataparser import leco_city_dataparser
from leco_plugin.scenes.mega_nerf import mega_nerf_dataparser
from leco_plugin.scenes.photographs import leco_photographs_dataparser

COMMANDS_PAGE, OPTIONS_PAGE = ROOT / "docs" / "commands.md", ROOT / "docs" / "options.md"
RULES_PAGE = ROOT / "docs" / "conformance.md"
RULES_MARKS = "<!-- rules: generated -->", "<!-- end of the rules -->"
COMMANDS_HEAD = """# Commands

Every command prints its help with `-h`. It exits with 0, with 2 for bad input and with 1 for a
failure; each error is one line, but for a wrong option, which is shown in a box. `--json FILE` also
writes the result as JSON. An option that is on is turned off by `--no-NAME`.

`ns-train`, `ns-eval`, `ns-render`, `ns-export` and `ns-viewer` are
[nerfstudio's](https://docs.nerf.studio). [Options](options.md) lists what our methods add to
`ns-train`.

This page is generated: `python benchmarks/reference_pages.py`.
"""
OPTIONS_HEAD = """# Options

What our methods add to the options of `ns-train`. `ns-train leco-occupancy -h` shows nerfstudio's
own as well.

- A section names a place, a row the end of an option: `.learn-steps` under
  `--pipeline.model.schedule` is `--pipeline.model.schedule.learn-steps`.
- Guided hosts, such as `leco-ngp`, have the options of the learning one level deeper, at
  `--pipeline.model.occupancy.learning` instead of `--pipeline.model`. All other places are the same
  for all methods.
- What is on or off takes `True` or `False`. The default `-` is none: the text says what is done
  then.
- Defaults are those of a CPU. Sizes of 0 are
  [automatic](capacity.md#leco-occupancy-automatic-sizes).

This page is generated: `python benchmarks/reference_pages.py`.
"""
PARSERS = {
    "leco-photographs": leco_photographs_dataparser,
    "mega-nerf": mega_nerf_dataparser,
    "leco-city": leco_city_dataparser,
}


def commands_page() -> str:
    """The whole of `docs/commands.md`."""
    return "\n".join([COMMANDS_HEAD, *map(_command, COMMANDS.values())])


def options_page() -> str:
    """The whole of `docs/options.md`."""
    shown: dict[type, str] = {}
    parts = [OPTIONS_HEAD, "## `leco-occupancy`\n"]
    parts += _options(leco_occupancy.config.pipeline, "--pipeline", shown)
    parts += _options(leco_occupancy.config, "--", shown, without={"pipeline"})
    parts += [
        "## Guided hosts: `leco-ngp`, `leco-nerfacto`, `leco-switch-nerf`, `leco-mega-nerf`\n"
    ]
    parts += _options(
        leco_ngp.config.pipeline, "--pipeline", shown, {"datamanager", "host", "learning"}
    )
    parts += ["## The host of `leco-switch-nerf` and `leco-mega-nerf`, and `switch-nerf`\n"]
    parts += [
        "`switch-nerf` has these at `--pipeline.model`.",
        "`leco-mega-nerf` has `.balance` `0.0` and `.routing` `nearest`.\n",
    ]
    parts += _options(leco_switch_nerf.config.pipeline.model.host, "--pipeline.model.host", shown)
    parts += [
        "## Data parsers\n",
        "They follow their name: `ns-train leco-occupancy mega-nerf --data DIR ...`.\n",
    ]
    for name, parser in PARSERS.items():
        parts += _options(parser.config, f"{name} --", shown)
    return "\n".join(parts)


def _command(command: Callable[..., None]) -> str:
    """A command with its usage, what it does, and a row for each argument."""
    text, _, arguments = inspect.getdoc(command).partition("\nArgs:\n")
    said = dict(re.findall(r"^    (\w+): (.*(?:\n {6,}.*)*)", arguments, re.MULTILINE))
    hints, usage, rows = get_type_hints(command, include_extras=True), [], []
    for name, parameter in inspect.signature(command).parameters.items():
        hint, flag = hints[name], f"--{name.replace('_', '-')}"
        positional = tyro.conf.Positional in getattr(hint, "__metadata__", ())
        shown = name.upper() if positional else flag
        if parameter.default is parameter.empty:
            usage.append(shown if positional else f"{flag} {name.upper()}")
        default = {False: "off", True: "on"}.get(parameter.default) if hint is bool else None
        default = default or _value(parameter.default)
        rows.append([f"`{shown}`", _kind(hint), default, _line(said[name])])
    line = " ".join(["leco", command.__name__, *usage])
    columns = table("argument | kind | default | what it is", rows)
    return "\n".join(
        [f"## `leco {command.__name__}`\n", f"    {line}\n", f"{text.rstrip()}\n", *columns, ""]
    )


def _options(
    config: Any, flag: str, shown: dict[type, str], without: Collection[str] = ()
) -> Iterator[str]:
    """A table for each config of ours from one on: fields that it declares itself.

    Args:
        flag: of the config.
        shown: where each class was described; a second time only defaults are.
        without: fields that are left out.
    """
    kind, start = type(config), "--" if flag.endswith("--") else "."
    declared = _said_of_fields(kind) if kind.__module__.startswith("leco_plugin") else {}
    inner, rows = [], []
    for field in dataclasses.fields(config):
        value, name = getattr(config, field.name), start + field.name.replace("_", "-")
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            inner += [] if field.name in without else [(value, flag.removesuffix("--") + name)]
        elif field.name in declared:
            rows.append([f"`{name}`", _value(value), _line(declared[field.name])])
    if rows and kind in shown:
        defaults = ", ".join(f"{name} {value}" for name, value, _ in rows)
        yield f"### `{flag.removesuffix(' --')}`\n\nAs `{shown[kind]}`. Defaults: {defaults}.\n"
    elif rows:
        shown[kind] = flag
        title = "all of `ns-train`" if flag == "--" else f"`{flag.removesuffix(' --')}`"
        yield "\n".join([f"### {title}\n", *table("option | default | what it is", rows), ""])
    for value, place in inner:
        yield from _options(value, place, shown, without)


def _said_of_fields(kind: type) -> dict[str, str]:
    """The string under each field that a config declares itself."""
    (body,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
    said = {}
    for field, under in zip(body.body, body.body[1:]):
        if isinstance(field, ast.AnnAssign) and isinstance(under, ast.Expr):
            said[field.target.id] = ast.literal_eval(under.value)
    return {name: text for name, text in said.items() if not name.startswith("_")}


def rules_page() -> str:
    """The page of the rules, with their table."""
    rows = [(f"`{r.name}`", ", ".join(sorted(r.checks)), r.reason, r.remedy) for r in RULES]
    body = "\n".join(table("rule | seams | why it matters | remedy", rows))
    return between(RULES_PAGE.read_text(), RULES_MARKS, body)


def _kind(hint: Any) -> str:
    """A type in words: choices, or the names of types."""
    if get_origin(hint) is Annotated:
        hint = get_args(hint)[0]
    if get_origin(hint) is Literal:
        return ", ".join(f"`{choice}`" for choice in get_args(hint))
    if arguments := [one for one in get_args(hint) if one not in (type(None), Ellipsis)]:
        return ", ".join(dict.fromkeys(map(_kind, arguments)))
    return {"Path": "path", "str": "text", "bool": "on or off"}.get(hint.__name__, hint.__name__)


def _value(value: Any) -> str:
    """A default; nothing where there is none."""
    if value is inspect.Parameter.empty:
        return "required"
    if value is None or value == () or (hasattr(value, "keys") and not value):
        return "-"
    values = value if isinstance(value, tuple | list) else [value]
    return f"`{' '.join(map(str, values))}`"


def _line(text: str) -> str:
    """Text for a cell."""
    return " ".join(text.split()).replace("|", "\\|")


if __name__ == "__main__":
    COMMANDS_PAGE.write_text(commands_page())
    OPTIONS_PAGE.write_text(options_page())
    RULES_PAGE.write_text(rules_page())
    gifts_page.PAGE.write_text(gifts_page.page())
    sys.exit(0)
