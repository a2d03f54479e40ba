"""Imported first: what is measured is the package beside this folder, whatever is installed."""

from __future__ import annotations

import sys
from pathlib import Path

_HERE = Path(__file__).resolve().parent

# last, so that the standard library's `profile`, which torch imports, is found before ours
_others = [folder for folder in sys.path if Path(folder).resolve() != _HERE]
sys.path[:] = [str(_HERE.parent), *_others, str(_HERE)]
