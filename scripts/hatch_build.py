"""Wheels carry the compiled kernels; scripts/setup makes those of an editable install."""

import subprocess
import sys
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class CarryKernels(BuildHookInterface[Any]):
    """Compiles the kernels before a wheel is put together."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """See hatchling."""
        if version == "editable":
            return
        subprocess.run([sys.executable, str(Path(self.root) / "scripts" / "carry_kernels.py")], check=True)
        build_data["pure_python"] = False
        build_data["infer_tag"] = True
