"""Arguments that several commands share, and what people type as values of them."""

from __future__ import annotations

import re
from argparse import ArgumentParser, ArgumentTypeError, Namespace
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ceres_cal.base.errors import InputError

if TYPE_CHECKING:
    from ceres_cal.observations import Observations, Prior

PRIOR_EXAMPLE = "overhead.height_m=4.02:0.01"
_IN_A_METRE = {"mm": 1000.0, "cm": 100.0, "m": 1.0}
_LENGTH = re.compile(r"\s*(.*?)\s*(mm|cm|m)\s*")


def add_calibration(parser: ArgumentParser, what: str = "file that `ceres-cal calibrate` or `refit` wrote") -> None:
    """The argument CALIBRATION."""
    parser.add_argument("calibration", metavar="CALIBRATION", type=Path, help=what)


def add_station(parser: ArgumentParser, what: str = "which station; may be left out where there is only one") -> None:
    """The option --station NAME."""
    parser.add_argument("--station", metavar="NAME", help=what)


def add_quiet(parser: ArgumentParser) -> None:
    """The option --quiet."""
    parser.add_argument("--quiet", action="store_true", help="no progress")


def add_jobs(parser: ArgumentParser, what: str, default: int) -> None:
    """The option --jobs: how many processes; 0 is one a core."""
    shown = default or "one a core"
    parser.add_argument("--jobs", type=int, default=default, metavar="N", help=f"{what} at a time; default: {shown}")


def add_output(parser: ArgumentParser, what: str, *, required: bool) -> None:
    """The option -o FILE."""
    parser.add_argument("-o", "--output", metavar="FILE", type=Path, required=required, help=f"file for {what}")


def add_report(parser: ArgumentParser) -> None:
    """The options --report PAGE and --images."""
    parser.add_argument(
        "--report",
        metavar="PAGE",
        type=Path,
        help="file for a page (.html): may it be trusted, for what, to how many mm",
    )
    parser.add_argument(
        "--images",
        metavar="PHOTOGRAPH",
        action="append",
        default=[],
        help="with --report: a photograph, or a folder of them, named like the frames: the model is drawn into them; "
        "repeatable",
    )


def add_prior(parser: ArgumentParser) -> None:
    """The option --prior of observations' cameras and stations."""
    parser.add_argument(
        "--prior",
        action="append",
        default=[],
        metavar="OWNER.NAME=VALUE:SIGMA",
        help="what is known beforehand: height_m or position_m of a station, phi, principal_point, aspect or a "
        f"coefficient of a camera, such as {PRIOR_EXAMPLE} or phi=812:5 (the owner may be left out where there is "
        "only one); repeatable",
    )


def add_timeout(parser: ArgumentParser) -> None:
    """The option --timeout S."""
    parser.add_argument("--timeout", type=float, metavar="S", help="give up after so many seconds; default: never")


def add_detection(parser: ArgumentParser) -> None:
    """What `detect board` and `detect rings` share: --timeout, and of what they write --camera, --station and -o."""
    add_timeout(parser)
    parser.add_argument("--camera", default="camera", metavar="NAME", help="name of the camera; default: camera")
    add_station(parser, "name of the station; default: that of the camera")
    add_output(parser, "the observations (.json or .npz)", required=True)


# ---- values ---------------------------------------------------------------------------------------------------------


def parse_number(text: str, where: str) -> float:
    """A finite number; InputError naming `where`."""
    try:
        value = float(text)
    except ValueError:
        raise InputError(f"{where}: {text.strip()!r} is not a number") from None
    if not abs(value) < float("inf"):
        raise InputError(f"{where}: {text.strip()!r} is not a finite number")
    return value


def parse_numbers(text: str, where: str) -> tuple[float, ...]:
    """Finite numbers between commas; InputError naming `where`."""
    return tuple(parse_number(part, where) for part in text.split(","))


def parse_length(text: str, where: str, unit: str = "m") -> float:
    """A length in `unit`, which is that of a plain number, too: "0.15", "150mm", "2.5 cm", "5m"."""
    found = _LENGTH.fullmatch(text)
    if found is None:
        return parse_number(text, where)
    return parse_number(found[1], where) * _IN_A_METRE[unit] / _IN_A_METRE[found[2]]


def parse_lengths(text: str, where: str) -> tuple[float, ...]:
    """Lengths between commas, in metres."""
    return tuple(parse_length(part, where) for part in text.split(","))


def length(unit: str) -> Callable[[str], float]:
    """The type of an argument that is a length in `unit`; its name says which."""

    def parse(text: str) -> float:
        try:
            return parse_length(text, "a length", unit)
        except InputError:
            raise ArgumentTypeError(f"{text!r} is no length: write a number of {unit}, or 5m, 150mm") from None

    return parse


def parse_board(text: str) -> tuple[int, int, float]:
    """COLUMNSxROWSxMM: inner corners, and the side of a square in metres."""
    parts = text.split("x")
    if len(parts) != 3 or not (parts[0].isdecimal() and parts[1].isdecimal()):
        raise InputError(f"--board {text!r}: write COLUMNSxROWSxMM, such as 9x6x100")
    return int(parts[0]), int(parts[1]), parse_length(parts[2], f"--board {text!r}", "mm") / 1000.0


def parse_names(text: str) -> list[str]:
    """Names between commas."""
    return [name.strip() for name in text.split(",") if name.strip()]


def add_height(parser: ArgumentParser, what: str, default_mm: float | None = None) -> None:
    """The option --height-mm."""
    parser.add_argument("--height-mm", type=length("mm"), metavar="MM", default=default_mm, help=what)


def height_m(args: Namespace) -> float:
    """--height-mm in metres; 0 where it was not given."""
    return 0.0 if args.height_mm is None else float(args.height_mm) / 1000.0


@dataclass(frozen=True)
class PriorNames:
    """The quantities that a `--prior` may name: of a station, and of a camera."""

    station: Sequence[str]
    camera: Sequence[str] = ()

    @property
    def known(self) -> str:
        of_camera = f", a camera {', '.join(self.camera)}" if self.camera else ""
        return f"a station has {', '.join(self.station)}{of_camera}"


def parse_prior(spec: str, observations: Observations, names: PriorNames) -> Prior:
    """The prior of a `--prior` argument: [OWNER.]QUANTITY=VALUE[,VALUE..]:SIGMA[,SIGMA..]; InputError that names it."""
    from ceres_cal.observations import prior_from_json

    where = f"--prior {spec!r}"
    left, equals, right = spec.rpartition("=")
    values, colon, sigmas = right.partition(":")
    if not (equals and colon):
        raise InputError(f"{where}: write OWNER.NAME=VALUE:SIGMA, such as {PRIOR_EXAMPLE}")
    name, _, quantity = left.strip().rpartition(".")
    if quantity not in (*names.station, *names.camera):
        raise InputError(f"{where}: {quantity!r} is unknown: {names.known}")
    owner, known = ("station", observations.stations) if quantity in names.station else ("camera", observations.cameras)
    if not name and len(known) == 1:
        name = next(iter(known))
    if name not in known:
        raise InputError(f"{where}: name one {owner} before the dot: {', '.join(known)}")
    parse = parse_lengths if quantity.endswith("_m") else parse_numbers
    sigma = parse(sigmas, f"{where}: sigma")
    if min(sigma) <= 0.0:
        raise InputError(f"{where}: sigma must be above 0")
    return prior_from_json(
        {
            owner: name,
            quantity: list(parse(values, where)),
            "sigma_m" if owner == "station" else "sigma": sigma[0] if len(sigma) == 1 else list(sigma),
        },
        where,
    )
