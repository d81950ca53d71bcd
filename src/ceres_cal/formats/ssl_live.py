"""What the commands need of the league's geometry: a packet to send, a field out of what came or lies in a file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ceres_cal.base.errors import naming
from ceres_cal.base.files import read_bytes
from ceres_cal.formats.export_format import Exported, ExportRequest
from ceres_cal.formats.ssl_cameras import SslOptions
from ceres_cal.formats.ssl_fields import target_of
from ceres_cal.formats.ssl_geometry import geometry_of, read_geometry
from ceres_cal.formats.ssl_messages import to_bytes
from ceres_cal.formats.ssl_multicast import wrapped
from ceres_cal.formats.ssl_settings import settings_field
from ceres_cal.formats.yaml_files import yaml_text
from ceres_cal.scene.targets import Target

if TYPE_CHECKING:
    from ceres_cal.calibration import Calibration


def ssl_packet(
    calibration: Calibration, stations: Sequence[str] | None = None, camera_id: str = "", before: bytes | None = None
) -> tuple[bytes, Exported]:
    """The wrapper packet of a calibration, and what it gets wrong.

    Args:
        before: a geometry.yml or a packet with the field and other cameras; by default the calibration's field.

    Raises:
        InputError: no such station, no field, or camera ids that do not fit.
    """
    names = tuple(calibration.stations if stations is None else stations)
    for name in names:
        calibration.station(name)
    request = ExportRequest(calibration, names, "", SslOptions(camera_id))
    data, exported = geometry_of(request, {} if before is None else read_geometry(before))
    return wrapped(data), exported


def geometry_content(geometry: Mapping[str, Any], ending: str) -> bytes:
    """An SSL_GeometryData as plain data, as a file of it."""
    return to_bytes("SSL_GeometryData", geometry) if ending == ".pb" else yaml_text(geometry).encode()


def read_ssl_target(path: str | Path) -> Target:
    """The field of a geometry.yml, a packet or ssl-vision's robocup-ssl.xml.

    Raises:
        InputError: naming the file; it is none of these, or has no field.
    """
    content = read_bytes(path)
    with naming(path):
        return settings_field(content) if b"<VarXML" in content else target_of(read_geometry(content)["field"])
