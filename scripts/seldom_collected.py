"""A plugin of mypy: a quarter of its time went by in searches for garbage, of which it makes hardly any.

They are fewer, with 1.0 instead of 0.6 GB of memory.
"""

import gc

from mypy.plugin import Plugin


def plugin(_version: str) -> type[Plugin]:
    gc.set_threshold(5_000_000)
    return Plugin
