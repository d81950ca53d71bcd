"""How the kernels are compiled and where the machine code is kept.

numba's cache looks at the file of the compiled function alone, not at the files it calls into. So the kernels are kept
in a folder named after all their sources: change one line of one of them and all are compiled anew.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba import config, njit

_CONFIG: Any = config  # numba makes its settings at import; no stub knows them


def _cache_folder() -> Path:
    base = _CONFIG.CACHE_DIR or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    sources = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        sources.update(path.read_bytes())
    return Path(base) / "ceres-cal" / sources.hexdigest()[:16]


CACHE_FOLDER = _cache_folder()


def _is_writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return False
    return os.access(folder, os.W_OK)


_CACHED = _is_writable(CACHE_FOLDER)


def jit(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile without the GIL; reassoc and contract let sums be vectorised, NaN and infinity keep their meaning."""
    others = _CONFIG.CACHE_DIR
    _CONFIG.CACHE_DIR = str(CACHE_FOLDER)
    try:
        compiled: Callable[..., Any] = njit(
            cache=_CACHED, nogil=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"}
        )(function)
    finally:
        _CONFIG.CACHE_DIR = others
    return compiled
