"""How long work on many images says how far it is."""

from __future__ import annotations

from collections.abc import Callable

ImageProgress = Callable[[int, int, str], None]
"""Called after each image with (images done, images in all, file name)."""
