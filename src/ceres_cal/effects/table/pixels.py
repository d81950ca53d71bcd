"""The pixels: skew, held numbers (aspect, principal point, phi), and detectors that count from another place."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.base.transforms import Pose
from ceres_cal.effects.columns import EffectColumns
from ceres_cal.effects.effect import CameraEffect, Case, Effect, Evidence, Words, amounts
from ceres_cal.problem.parameters import intrinsic_names
from ceres_cal.problem.quantities import pixel_slopes


class Skew(CameraEffect):
    """The axes of the pixels are not perpendicular: x grows with y."""

    kind = "skew"

    def displacement(self, case: Case, camera: str, pixels: Array) -> Array | None:
        one = case.estimate.cameras[camera]
        if intrinsic_names(one.lens).index("skew") in case.problem.layout.free[camera]:
            return None
        return np.asarray(one.offsets(pixels)[:, 1:, None] * [[1.0], [0.0]])

    def words(self, evidence: Evidence) -> Words:
        skew, sd = 1e3 * evidence.score.amount, 1e3 * evidence.score.sd
        return Words(
            f"camera {evidence.score.subject!r}: the axes of its pixels lean by {skew[0]:.2f} ± {sd[0]:.2f} mrad "
            f"({evidence.size})",
            "calibrate with --free-skew, which no other program reads; better take pictures as the sensor gives them, "
            "neither warped nor stabilised",
            amounts(["skew"], skew, sd, "mrad"),
        )


class HeldNumbers(CameraEffect):
    """Numbers of the pixels that are held; places: theirs in the intrinsics vector."""

    places: ClassVar[list[int]]

    def displacement(self, case: Case, camera: str, pixels: Array) -> Array | None:
        if set(self.places) & set(case.problem.layout.free[camera].tolist()):
            return None
        one = case.estimate.cameras[camera].at(Pose.identity())
        return pixel_slopes(one, one.rays(pixels)).intrinsics[:, :, self.places]


class Aspect(HeldNumbers):
    """How high pixels are beside their width."""

    kind = "aspect"
    places: ClassVar[list[int]] = [1]

    def words(self, evidence: Evidence) -> Words:
        score = evidence.score
        held = evidence.case.estimate.cameras[score.subject].aspect
        return Words(
            f"camera {score.subject!r}: its pixels are not as wide as high: aspect {held + score.amount[0]:.5f} ± "
            f"{score.sd[0]:.5f}, not {held:g} ({evidence.size})",
            "calibrate with --free-aspect",
            amounts(["aspect"], score.amount, score.sd, ""),
        )


class PrincipalPoint(HeldNumbers):
    """Where the optical axis meets the image."""

    kind = "principal point"
    places: ClassVar[list[int]] = [2, 3]

    def words(self, evidence: Evidence) -> Words:
        score = evidence.score
        x, y = score.amount
        return Words(
            f"camera {score.subject!r}: the principal point is held, but the residuals ask for it {x:+.1f}, {y:+.1f} "
            f"px from there ({evidence.size})",
            "let it free",
            amounts(["cx", "cy"], score.amount, score.sd, "px"),
        )


class Phi(HeldNumbers):
    """The focal length."""

    kind = "phi"
    places: ClassVar[list[int]] = [0]

    def words(self, evidence: Evidence) -> Words:
        score = evidence.score
        return Words(
            f"camera {score.subject!r}: phi is held, but residuals ask for {score.amount[0]:+.2f} ± "
            f"{score.sd[0]:.2f} px ({evidence.size})",
            "let it free, or give it as a prior with a sigma",
            amounts(["phi"], score.amount, score.sd, "px"),
        )


_HALF = "this is the half pixel between counting from the centre and from the corner of the top-left pixel: "


class PointsShifted(Effect):
    """A camera's points lie aside of its curves: two detectors that count pixels from different places."""

    kind = "points shifted"
    absorbed = True

    def columns(self, case: Case) -> Iterator[EffectColumns]:
        is_curve, camera = case.equations.is_curve, case.camera
        both = np.isin(camera, camera[is_curve & case.model.used])
        group = np.where(~is_curve & both, camera, -1)
        yield EffectColumns(self.kind, case.equations.direction * ~is_curve[:, None], group, case.cameras)

    def words(self, evidence: Evidence) -> Words:
        # How near to half a pixel a shift must be to be called that: in standard deviations, and px.
        half_sd, half_px = 3.0, 0.1
        px, sd = evidence.score.amount, evidence.score.sd
        half = bool(np.all(np.abs(np.abs(px) - 0.5) < np.maximum(half_sd * sd, half_px)))
        return Words(
            f"camera {evidence.score.subject!r}: its points are shifted against its curves by ({px[0]:+.2f} ± "
            f"{sd[0]:.2f}, {px[1]:+.2f} ± {sd[1]:.2f}) px ({evidence.size})",
            f"{_HALF if half else ''}let both detectors count from the centre of the top-left pixel",
            amounts(("x", "y"), px, sd, "px"),
        )


EFFECTS = (Skew(), Aspect(), PrincipalPoint(), Phi(), PointsShifted())
