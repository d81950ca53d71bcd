"""calibsense: its refit with covariance, and its audit, called as in "Python API" of its README.

According to its README, `instrument` re-estimates five coefficients by default; distortion_terms=8 and model="fisheye"
are its other lenses. It states a covariance, and a second one clustered by view. `run_audit` returns its judgement
(`trustworthy`, caveats, and findings with severity WARNING or CRITICAL).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from importlib import import_module
from typing import Any

import numpy as np
from benchmarks.peers import Corners

from beside.opencv_peer import FISHEYE, NAMES, brown, fisheye
from beside.peer_fit import PeerFit
from beside.starts import wide_focal

_WARNING = 2  # of its Severity


def session_of(corners: Corners, model: str) -> Any:
    """calibsense's session for these corners."""
    peer = import_module("calibsense")
    columns, rows = corners.grid.tolist()
    target = peer.Checkerboard(columns=columns, rows=rows, square_size=1e3 * float(corners.square_m))
    cuts = np.searchsorted(corners.view, np.arange(1, corners.frames))
    parts = zip(np.split(corners.feature, cuts), np.split(corners.pixels, cuts), strict=True)
    views = [peer.ViewObservations(f"{n:05d}", features, pixels) for n, (features, pixels) in enumerate(parts)]
    size = tuple(corners.image_size.tolist())
    return peer.CalibrationSession(peer.ObservationSet(target, size, tuple(views)), prior=_guess(peer, model, corners))


def _guess(peer: Any, model: str, corners: Corners) -> Any:
    """The prior calibration that starts its refit; it is given for a wide lens only."""
    if model != "fisheye" or (focal := wide_focal(corners)) is None:
        return None
    width, height = corners.image_size.tolist()
    camera = peer.FisheyeKannalaBrandt(focal, focal, 0.5 * (width - 1), 0.5 * (height - 1), np.zeros(4))
    return peer.CalibrationRecord(camera, (width, height))


def _fit(model: str, terms: int, clustered: bool, audited: bool, corners: Corners) -> PeerFit:
    peer = import_module("calibsense")
    session = session_of(corners, model)
    options = peer.RefitOptions(model=model, distortion_terms=terms)
    start = time.perf_counter()
    fit = peer.instrument(session, options)
    seconds = time.perf_counter() - start
    names = (FISHEYE if model == "fisheye" else NAMES)[: 4 + (4 if model == "fisheye" else terms)]
    every = dict(zip(fit.camera.parameter_names(), fit.camera.to_vector().tolist(), strict=True))
    values = np.array([every[name] for name in names])
    own = fit.covariance.robust if clustered else fit.covariance
    free = list(fit.covariance.intrinsic_names)
    square = own.covariance if clustered else own.intrinsic
    at = [free.index(name) for name in names]
    covariance = np.asarray(square)[np.ix_(at, at)]
    return PeerFit(
        names, values, fisheye if model == "fisheye" else brown, corners.board, float(fit.covariance.sigma),
        np.sqrt(np.diag(covariance)), covariance, said=_said(session, options) if audited else (), seconds=seconds,
    )  # fmt: skip


def _said(session: Any, options: Any) -> tuple[str, ...]:
    audit = import_module("calibsense.report").run_audit(session, options)
    findings = [one for one in audit.diagnosis.findings if int(one.severity) >= _WARNING]
    return (*audit.caveats(), *(f"{one.severity.label}: {one.title}: {one.summary}" for one in findings))


SETTINGS: dict[str, Callable[[Corners], PeerFit]] = {
    "default": partial(_fit, "pinhole", 5, False, False),
    "clustered": partial(_fit, "pinhole", 5, True, False),
    "rational": partial(_fit, "pinhole", 8, False, False),
    "rational, clustered": partial(_fit, "pinhole", 8, True, False),
    "fisheye": partial(_fit, "fisheye", 5, False, False),
    "fisheye, clustered": partial(_fit, "fisheye", 5, True, False),
    "audit": partial(_fit, "pinhole", 5, False, True),
}
