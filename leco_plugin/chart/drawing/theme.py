"""How a chart looks on a light page and on a dark one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

MARKERS = "osD^vPX*<>"


@dataclass(frozen=True)
class Theme:
    """Colours on one kind of page."""

    page: str
    ink: str
    faint: str
    colours: tuple[str, ...]
    """Told apart also by colour-blind readers, together with the markers."""


LIGHT = Theme(
    "#ffffff",
    "#1f2328",
    "#d6dbe1",
    (
        *("#0969a8", "#c2410c", "#1a7f4b", "#8a3ffc", "#946200"),
        *("#bf2a6b", "#3b7d8c", "#5c5f66", "#56771a", "#a0522d"),
    ),
)
DARK = Theme(
    "#0d1117",
    "#e6edf3",
    "#30363d",
    (
        *("#58b1ff", "#ff9a5c", "#4cd08a", "#c9a3ff", "#e6bd4a"),
        *("#ff8ab5", "#7fd6e0", "#b6bcc4", "#b5d66b", "#e0a878"),
    ),
)


def style(i: int, theme: Theme) -> dict[str, Any]:
    return {"color": theme.colours[i % len(theme.colours)], "marker": MARKERS[i % len(MARKERS)]}


def plain(axes: Any, theme: Theme) -> None:
    axes.grid(color=theme.faint, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def themed(theme: Theme, size: float = 12) -> Any:
    """A context in which matplotlib draws with a theme's ink, on its page, and in type of a size,
    points."""
    from matplotlib import rc_context

    parts = ("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color")
    settings: dict[Any, Any] = {"font.size": size, "axes.facecolor": theme.page}
    return rc_context(settings | dict.fromkeys(parts, theme.ink))
