"""The paper's own numbers as text: a1, a2, a3, K, H, R, t and the angles (sections 2 to 3.6)."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ceres_cal.base import Array, InputError, Pose, euler_from_rotation
from ceres_cal.formats.format import Export, ExportFormat, ExportRequest, ImportFormat, ImportRequest, calibration_of
from ceres_cal.formats.loss import camera_loss, field_box, loss_words
from ceres_cal.formats.yaml_files import numbers_at
from ceres_cal.scene import Camera, Radial, nearest


def _export(request: ExportRequest) -> Export:
    (name,) = request.stations
    camera = request.calibration.station(name)
    ours = nearest(camera, Radial.blank((2, 3)))
    loss = camera_loss(name, camera, ours.project, field_box(request.calibration.targets))
    a2, a3 = ours.lens.values
    rows: dict[str, ArrayLike] = {
        "image_size": ours.image_size,
        "a1": 1.0,
        "a2": a2,
        "a3": a3,
        "phi": ours.phi,
        "K": ours.matrix,
        "R": ours.cam_from_world.rotation,
        "t": ours.position,
        "alpha_beta_gamma": euler_from_rotation(ours.cam_from_world.rotation),
        "H": ours.homography(),
    }
    comments = [
        f"station {name}, after R. Rojas, Calibrating an Overhead Video Camera; pixels, metres, radians",
        "r' = a1 r + a2 r^2 + a3 r^3 from the measured to the ideal radius; x_cam = R (x_world - t)",
        "H takes (x, y, 1) of the floor to the image plane at depth 1",
        *loss_words(loss),
    ]
    text = "".join(f"# {line}\n" for line in comments) + "".join(f"{key} = {_text(v)}\n" for key, v in rows.items())
    return Export(text.encode(), (loss,), "a1, a2, a3, phi, K, R, t, angles and H")


def _text(values: ArrayLike) -> str:
    return "; ".join(" ".join(repr(float(v)) for v in row) for row in np.atleast_2d(values))


def _read(request: ImportRequest) -> Any:
    given = dict(re.findall(r"^\s*(\w+)\s*=\s*([^#\n]*)", request.text, re.MULTILINE))

    def numbers(name: str, count: int) -> Array:
        text = given.get(name, "missing")
        return numbers_at(text.replace(";", " ").split(), name, count, repr(text))

    (a1,), (a2,), (a3,), k = numbers("a1", 1), numbers("a2", 1), numbers("a3", 1), numbers("K", 9)
    lens, phi = Radial.from_paper(a1, a2, a3, k[0])
    width, height = numbers("image_size", 2)
    turn = numbers("R", 9).reshape(3, 3)
    if np.max(np.abs(turn)) > 2.0 or np.max(np.abs(turn @ turn.T - np.eye(3))) > 1e-6:
        raise InputError("R is not a rotation matrix")
    pose = Pose.looking(numbers("t", 3), turn)
    camera = Camera((int(width), int(height)), phi, (k[2], k[5]), lens, k[4] / k[0], pose)
    camera.require_monotone(request.path.stem)
    return calibration_of("the paper's numbers", {request.path.stem: camera})


FORMATS = (
    ExportFormat("paper", "the paper's a1, a2, a3, K, H, R, t and angles as text", (".txt",), _export),
    ImportFormat("paper", "the paper's numbers as text", (".txt",), lambda content: b"a1 =" in content, _read),
)
