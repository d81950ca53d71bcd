"""What a format that is read is: it makes a calibration, or observations, of the files of others."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ceres_cal.formats.export_format import NoOptions

if TYPE_CHECKING:
    from ceres_cal.calibration import Calibration
    from ceres_cal.observations import Observations
    from ceres_cal.scene.camera import Camera
    from ceres_cal.scene.foreign import ForeignCamera
    from ceres_cal.scene.targets import Target


@dataclass(frozen=True, eq=False)
class ImportRequest:
    """What is to be read.

    Attributes:
        path: of the file or folder. content: of the file, empty of a folder. options: an instance of the format's.
    """

    path: Path
    content: bytes
    options: Any

    @property
    def text(self) -> str:
        """The content as text."""
        return self.content.decode("utf-8-sig", errors="replace")


@dataclass(frozen=True)
class ImportFormat:
    """A format.

    Attributes:
        name: as it is asked for; that of the export format, where there is one. description: one line.
        endings: that its file may have. recognises: whether a file that ends so is one, by its content.
        read: makes what it holds; raises InputError, whose text need not name the file.
        options: as those of an `ExportFormat`.
    """

    name: str
    description: str
    endings: tuple[str, ...]
    recognises: Callable[[bytes], bool]
    read: Callable[[ImportRequest], Calibration | Observations]
    options: type[Any] = NoOptions


@dataclass(frozen=True, eq=False)
class ImportedCameras:
    """What a file of cameras says.

    Attributes:
        cameras: by name, ours or others'. targets: that it describes. warnings: what to know of it, a line each.
    """

    cameras: Mapping[str, Camera | ForeignCamera]
    targets: Mapping[str, Target] = field(default_factory=dict)
    warnings: Sequence[str] = ()

    def calibration(self, source: str) -> Calibration:
        """The cameras as a calibration of which nobody says how well it is known.

        A camera without a pose is the world, as one that saw only boards.
        """
        from ceres_cal.calibration import Calibration, Fit
        from ceres_cal.problem.parameters import Estimate, Options, Station
        from ceres_cal.problem.structure import EXACT

        cameras, warnings = self._ours()
        stations = {name: Station(name, camera.cam_from_world) for name, camera in cameras.items()}
        bare = {name: camera.at(type(camera.cam_from_world).identity()) for name, camera in cameras.items()}
        lens = next(iter(cameras.values())).lens
        options = Options(lens=lens.kind, powers=lens.powers, terms=lens.terms, usual_camera=False)
        return Calibration(
            Estimate(bare, stations, {}, EXACT),
            dict(self.targets),
            Fit(0, 0, 0.0, 0.0, 1.0, 1.0, 0),
            (),
            f"read from {source}",
            True,
            0,
            (),
            dict.fromkeys(cameras, "file"),
            tuple(warnings),
            options,
            "",
        )

    def _ours(self) -> tuple[dict[str, Camera], list[str]]:
        """Each camera as ours, and what to know of them."""
        from ceres_cal.scene.camera import Camera

        warnings, cameras = [*self.warnings], {}
        for name, given in self.cameras.items():
            if isinstance(given, Camera):
                cameras[name] = given
                continue
            cameras[name], (rms, worst) = Camera.from_foreign(given)
            if worst > 0.0:
                what = f"its {given.model} model is held as the nearest {cameras[name].lens.kind} lens"
                warnings.append(f"camera {name!r}: {what}, off by {rms:.2g} px rms and {worst:.2g} px at most")
            if given.cam_from_world is None:
                warnings.append(f"camera {name!r}: the file has no pose of it over a field: the camera is the world")
        return cameras, warnings
