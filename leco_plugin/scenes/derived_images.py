"""Pictures made from others, once: resized, cut, unpacked.

nerfstudio's data managers, whichever they are, read pictures and masks by file name.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path

from PIL import Image

from leco_plugin.scenes.input_error import InputError, one_line
from leco_plugin.scenes.whole_files import write_whole

_FORMATS = ("JPEG", "PNG")
"""By content, whatever the name: Pillow hands some other kinds of files to other programs."""


class DerivedImages:
    """A folder of PNG files that are made when they are first asked for.

    A file's name depends on its source (path, size, time of its last change) and on what was made
    of it, so that a changed source is never taken for the old one.
    """

    def __init__(
        self, folder: Path, remedy: str = "give another folder for derived pictures with --cache"
    ) -> None:
        """With what to do where nothing can be written."""
        self.folder, self.remedy = folder, remedy

    def get(self, source: Path, recipe: str, make: Callable[[], Image.Image]) -> Path:
        """The file with what `make` makes of `source`; `recipe` names it.

        Raises:
            InputError: one line; the source cannot be read as a picture, or nothing can be written.
        """
        status = source.stat()
        known_by = f"{source.resolve()} {status.st_size} {status.st_mtime_ns} {recipe}"
        digest = hashlib.blake2b(known_by.encode(), digest_size=8).hexdigest()
        path = self.folder / f"{source.stem}-{digest}.png"
        if not path.exists():
            self.put(path, make())
        return path

    def put(self, path: Path, image: Image.Image) -> None:
        """Writes an image under its name. InputError if that cannot be done."""
        try:
            write_whole(path, lambda file: image.save(file, format="PNG"))
        except OSError as error:
            raise InputError(
                f"{path} cannot be written ({error.strerror or error}); {self.remedy}"
            ) from None


def open_image(path: Path) -> Image.Image:
    """A decoded picture. InputError, in one line, if it is none."""
    try:
        with Image.open(path, formats=_FORMATS) as image:
            image.load()
            return image
    # Damaged pictures raise whatever their decoders meet.
    except Exception as error:  # noqa: BLE001
        raise _unreadable(path, error) from None


def image_header(path: Path) -> tuple[tuple[int, int], str]:
    """Width and height of a picture, and its mode. InputError as of `open_image`."""
    try:
        with Image.open(path, formats=_FORMATS) as image:
            return image.size, image.mode
    except Exception as error:  # noqa: BLE001 (as above)
        raise _unreadable(path, error) from None


def _unreadable(path: Path, error: Exception) -> InputError:
    said = one_line(error, 120)
    return InputError(f"{path} cannot be read as a picture: {said}")
