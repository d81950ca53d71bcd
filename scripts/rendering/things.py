"""Things on the field: robots with coloured covers, balls, boxes, and people's shadows on the floor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.base.words import ROBOT_TOP_M
from ceres_cal.scene.camera import Camera

Colour = tuple[float, float, float]
"""Blue, green and red, as shares of white."""

ROBOT_RADIUS_M, BALL_RADIUS_M = 0.09, 0.0215
_BODY: Colour = (0.04, 0.04, 0.04)
_COVER: Colour = (0.08, 0.08, 0.08)
_ORANGE: Colour = (0.05, 0.4, 0.95)
_TEAMS: tuple[Colour, ...] = ((0.85, 0.3, 0.05), (0.1, 0.8, 0.85))  # blue, yellow
_MARKERS: tuple[Colour, ...] = ((0.25, 0.85, 0.2), (0.7, 0.25, 0.9))  # green, pink
_MARKER_RADII_M = (0.025, 0.02)
_MARKER_PLACES_M = ((0.055, 0.035), (0.055, -0.035), (-0.055, 0.055), (-0.055, -0.055))
_TURN = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
_CIRCLE = np.column_stack([np.cos(_TURN), np.sin(_TURN)])


@dataclass(frozen=True)
class Robot:
    """A robot at (x, y) m: a cylinder whose cover has a team's disc and four markers, chosen by `pattern`."""

    x_m: float
    y_m: float
    heading_rad: float
    pattern: int


@dataclass(frozen=True)
class Ball:
    """A ball on the floor at (x, y) m."""

    x_m: float
    y_m: float


@dataclass(frozen=True)
class Box:
    """A box, a mat or a person at (x, y) m: half sides, height and heading, and the colour of its top."""

    x_m: float
    y_m: float
    half_sides_m: tuple[float, float]
    height_m: float
    heading_rad: float
    colour: Colour


@dataclass(frozen=True)
class Shadow:
    """A person's shadow on the floor: an ellipse around (x, y) m with half axes in m."""

    x_m: float
    y_m: float
    half_length_m: float
    half_width_m: float
    heading_rad: float


Thing = Robot | Ball | Box

Patch = tuple[Array, Colour]
"""A filled polygon (N, 2) px."""


def outline(thing: Thing, camera: Camera) -> Array:
    """(N, 2) px: the border of all that a thing hides, NaN where the camera cannot show it."""
    if isinstance(thing, Ball):
        return camera.project(_ball_horizon(thing, camera.position))
    if isinstance(thing, Box):
        return _convex(np.vstack([_level(thing, 0.0, camera), _level(thing, thing.height_m, camera)]))
    middle = np.array([thing.x_m, thing.y_m])
    floor = np.column_stack([middle + ROBOT_RADIUS_M * _CIRCLE, np.zeros(len(_CIRCLE))])
    return _convex(np.vstack([camera.project(floor), _disc(middle, ROBOT_RADIUS_M, camera)]))


def patches(thing: Thing, camera: Camera) -> list[Patch]:
    """The coloured polygons of a thing, the farthest first."""
    if isinstance(thing, Ball):
        return [(outline(thing, camera), _ORANGE)]
    if isinstance(thing, Box):
        red, green, blue = (0.5 * share for share in thing.colour)
        return [(outline(thing, camera), (red, green, blue)), (_level(thing, thing.height_m, camera), thing.colour)]
    middle = np.array([thing.x_m, thing.y_m])
    cosine, sine = np.cos(thing.heading_rad), np.sin(thing.heading_rad)
    turn = np.array([[cosine, -sine], [sine, cosine]])
    polygons = [
        (outline(thing, camera), _BODY),
        (_disc(middle, ROBOT_RADIUS_M, camera), _COVER),
        (_disc(middle, _MARKER_RADII_M[0], camera), _TEAMS[thing.pattern % 2]),
    ]
    for number, place in enumerate(_MARKER_PLACES_M):
        colour = _MARKERS[(thing.pattern >> (number + 1)) % 2]
        polygons.append((_disc(middle + turn @ place, _MARKER_RADII_M[1], camera), colour))
    return polygons


def shadow_outline(shadow: Shadow, camera: Camera) -> Array:
    """(N, 2) px: the border of a shadow."""
    cosine, sine = np.cos(shadow.heading_rad), np.sin(shadow.heading_rad)
    ellipse = _CIRCLE * (shadow.half_length_m, shadow.half_width_m)
    floor = ellipse @ np.array([[cosine, sine], [-sine, cosine]]) + (shadow.x_m, shadow.y_m)
    return camera.project(np.column_stack([floor, np.zeros(len(floor))]))


def _level(box: Box, height_m: float, camera: Camera) -> Array:
    """The border of a box at a height; its sides are sampled, since a lens bends them."""
    steps = np.linspace(-1.0, 1.0, 12, endpoint=False)
    ones = np.ones(len(steps))
    sides = [(steps, -ones), (ones, steps), (-steps, ones), (-ones, -steps)]
    border = np.vstack([np.column_stack(one) for one in sides]) * box.half_sides_m
    cosine, sine = np.cos(box.heading_rad), np.sin(box.heading_rad)
    place = border @ np.array([[cosine, sine], [-sine, cosine]]) + (box.x_m, box.y_m)
    return camera.project(np.column_stack([place, np.full(len(place), height_m)]))


def _disc(middle: Array, radius_m: float, camera: Camera) -> Array:
    place = middle + radius_m * _CIRCLE
    return camera.project(np.column_stack([place, np.full(len(place), ROBOT_TOP_M)]))


def _ball_horizon(ball: Ball, position: Array) -> Array:
    """(N, 3) m: the circle on a ball where lines of sight are tangent."""
    middle = np.array([ball.x_m, ball.y_m, BALL_RADIUS_M])
    away = position - middle
    distance = float(np.linalg.norm(away))
    sine = BALL_RADIUS_M / distance
    away = away / distance
    across = np.cross(away, [1.0, 0.0, 0.0] if abs(away[0]) < 0.9 else [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)
    circle = _CIRCLE @ np.array([across, np.cross(away, across)])
    return np.asarray(middle + BALL_RADIUS_M * (sine * away + np.sqrt(1.0 - sine**2) * circle))


def _convex(points: Array) -> Array:
    """The corners of the convex hull of points (N, 2), in order; NaN if a point is NaN."""
    if not np.all(np.isfinite(points)):
        return np.full((1, 2), np.nan)
    ordered = points[np.lexsort((points[:, 1], points[:, 0]))]

    def half(rows: Array) -> list[Array]:
        chain: list[Array] = []
        for point in rows:
            while len(chain) > 1:
                first, second = chain[-1] - chain[-2], point - chain[-1]
                if first[0] * second[1] - first[1] * second[0] > 0.0:
                    break
                chain.pop()
            chain.append(point)
        return chain[:-1]

    return np.array(half(ordered) + half(ordered[::-1]))
