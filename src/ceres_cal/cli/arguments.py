"""Arguments that several commands share, and parsers of their values."""

from __future__ import annotations

import re
from argparse import ArgumentTypeError
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from ceres_cal import observations, scene
from ceres_cal.base import IN_A_METRE, InputError, did_you_mean, finite, printable
from ceres_cal.cli.command import REQUIRED, QuietArguments, argument, option, whole

if TYPE_CHECKING:
    from ceres_cal.observations import Prior
    from ceres_cal.problem.parameters import Options

_T = TypeVar("_T")
PRIOR_EXAMPLE = "overhead.height_m=4.02:0.01"
FACING_EXAMPLE = "LeftGoalLine=top"
_ESTIMATE_EXAMPLE = "length,width"
_PLACES = {"FILE": "file ", "DIR": "folder ", "FOLDER": "folder "}
Loss = Literal["trivial", "huber", "soft_l1", "cauchy", "tukey"]
_LENGTH = re.compile(rf"\s*(.*?)\s*({'|'.join(IN_A_METRE)})\s*")


def calibration_argument(what: str = "file that `ceres-cal calibrate` or `refit` wrote") -> Any:
    """The argument CALIBRATION."""
    return argument("CALIBRATION", what)


def station_option(what: str = "which station; may be left out where there is only one") -> Any:
    """The option --station NAME."""
    return option(what, "NAME", read=name)


def camera_option(what: str = "name of the camera", default: str | None = "camera") -> Any:
    """The option --camera NAME."""
    return option(what, "NAME", default, read=name)


def board_option(what: str, **about: Any) -> Any:
    """The option --board for a chessboard."""
    return option(what, "COLUMNSxROWSxMM", elsewhere=("columns", "rows", "square"), **about)


def output_option(what: str, default: Any = REQUIRED, metavar: str = "FILE") -> Any:
    """The option -o FILE, or -o FOLDER."""
    return option(f"{_PLACES.get(metavar, '')}for {what}", metavar, default, flags=("-o", "--output"))


def prior_option(metavar: str = "OWNER.NAME=VALUE:SIGMA", what: str = "", group: str = "") -> Any:
    """The option --prior for cameras and stations of the observations."""
    every = (
        "what is known beforehand: height_m or position_m of a station; phi (the focal length, px), principal_point, "
        f"aspect (fy / fx) or a coefficient of a camera, such as {PRIOR_EXAMPLE} or phi=812:5 (the owner may be left "
        "out where there is only one)"
    )
    return option(what or every, metavar, repeatable=True, group=group, elsewhere=("height_mm",))


def estimate_option(**about: Any) -> Any:
    """The option --estimate."""
    return option(
        f"dimensions of the field that are not known and solved for, such as {_ESTIMATE_EXAMPLE}: one length of it, or "
        "a height, must be known; width=5.5 says where to start, width=5.50:20mm how well it is known",
        "NAME,...",
        repeatable=True,
        **about,
    )


def not_painted_option(what: str, **about: Any) -> Any:
    """The option --not-painted for lines."""
    return option(what, "NAME,...", "", **about)


def height_option(what: str, default_mm: float | None = None, **about: Any) -> Any:
    """The option --height-mm."""
    return option(what, "MM", default_mm, read=length("mm"), **about)


def false_alarms_option(what: str) -> Any:
    """The option --false-alarms."""
    return option(f"{what}, such as 0.01 or 1%", "SHARE", 0.01, read=share)


def timeout_option() -> Any:
    """The option --timeout S."""
    return option("give up after so many seconds; default: never", "S")


def frames_option() -> Any:
    """The option --frames N, for videos."""
    what = "number of photographs to take from a video, the sharpest of as many parts"
    return option(what, "N", 30, read=whole(1))


class ReportArguments(QuietArguments):
    """Arguments of a command that may write its result, and a report."""

    output: Path | None
    report: Path | None = option("write a report (.html): can it be trusted, for what, to how many mm", "PAGE")
    images: tuple[str, ...] = option(
        "with --report: a photograph, or a folder of them, named like the frames: the model is drawn into them",
        "PHOTOGRAPH",
        repeatable=True,
        beside=("report",),
    )


# ---- values ---------------------------------------------------------------------------------------------------------


def parse_number(text: str, where: str) -> float:
    """Parse a finite number; an InputError names `where`."""
    return finite(text, InputError(f"{where}: {text.strip()!r} is not a finite number, such as -0.15"))


def parse_numbers(text: str, where: str) -> tuple[float, ...]:
    """Parse finite numbers between commas; an InputError names `where`."""
    return tuple(parse_number(part, where) for part in text.split(","))


def parse_length(text: str, where: str, unit: str = "m") -> float:
    """Parse a length in `unit`, which is also the unit of a plain number: "0.15", "150mm", "2.5 cm", "5m"."""
    found = _LENGTH.fullmatch(text)
    if found is None:
        return parse_number(text, where)
    return parse_number(found[1], where) * IN_A_METRE[unit] / IN_A_METRE[found[2]]


def parse_lengths(text: str, where: str) -> tuple[float, ...]:
    """Parse lengths between commas, in metres."""
    return tuple(parse_length(part, where) for part in text.split(","))


def length(unit: str) -> Callable[[str], float]:
    """Return the type of an argument that is a length in `unit`, which its name states."""

    def parse(text: str) -> float:
        try:
            return parse_length(text, "a length", unit)
        except InputError:
            raise ArgumentTypeError(f"{text!r} is not a length: write a number of {unit}, or 5m, 150mm") from None

    return parse


def share(text: str) -> float:
    """The type of --false-alarms: 0.01, or 1%."""
    where = f"--false-alarms {text!r}"
    value = parse_number(text.rstrip("%"), where) / (100.0 if text.endswith("%") else 1.0)
    if not 0.0 < value < 1.0:
        raise InputError(f"{where}: give a share between 0 and 1, such as 0.01")
    return value


def name(text: str) -> str:
    """The type of an argument that is a name, which files hold as UTF-8."""
    if not text or text != printable(text):
        raise ArgumentTypeError(f"'{printable(text)}' is not a name in UTF-8: give another one")
    return text


def parse_board(text: str) -> tuple[int, int, float]:
    """Parse COLUMNSxROWSxMM: inner corners, and the side of a square; return the side in metres."""
    parts = text.lower().split("x")
    if len(parts) != 3 or not (parts[0].isdecimal() and parts[1].isdecimal()):
        raise InputError(f"board {text!r}: write COLUMNSxROWSxSQUARE, such as 9x6x25mm")
    return int(parts[0]), int(parts[1]), parse_length(parts[2], f"board {text!r}", "mm") / 1000.0


def is_described(text: str) -> bool:
    """Whether a target is spelled out as `{"kind": ...}`, or in a file."""
    return text.lstrip().startswith("{") or text.endswith(".json")


def board_words(text: str) -> list[str]:
    """Return the arguments of `detect board` for a board: COLUMNSxROWSxMM, or a target."""
    if is_described(text):
        return ["--target", text]
    columns, rows, square_m = parse_board(text)
    return ["--columns", str(columns), "--rows", str(rows), "--square", f"{1e3 * square_m:.9g}mm"]


def repeated(option: str, values: Iterable[str]) -> list[str]:
    """Return an option repeated with each of the values."""
    return [word for value in values for word in (option, value)]


def named_values(option: str, form: str, parse: Callable[[str, str], _T], specs: Iterable[str]) -> dict[str, _T]:
    """Parse an option that is given as NAME=VALUE; return the values by name.

    Args:
        form: how it is written. parse: parser of a value, which also takes its name in messages.
    """
    found: dict[str, _T] = {}
    for spec in specs:
        where = f"{option} {spec!r}"
        name, _, value = (part.strip() for part in spec.partition("="))
        if not (name and value):
            raise InputError(f"{where}: write {form}")
        if name in found:
            raise InputError(f"{where}: {name} is given twice")
        found[name] = parse(value, where)
    return found


def parse_facing(specs: Iterable[str]) -> dict[str, str]:
    """Parse --facing: the side of the picture by name."""
    return named_values("--facing", f"NAME=SIDE, such as {FACING_EXAMPLE}", lambda side, _: side, specs)


def parse_names(text: str) -> list[str]:
    """Parse names between commas."""
    return [name.strip() for name in text.split(",") if name.strip()]


def metres(height_mm: float | None) -> float:
    """Convert --height-mm to metres; 0 where it was not given."""
    return 0.0 if height_mm is None else height_mm / 1000.0


def parse_prior(spec: str, owners: Mapping[str, Collection[str]], quantities: Mapping[str, Sequence[str]]) -> Prior:
    """Parse a `--prior` argument: [OWNER.]QUANTITY=VALUE[,VALUE..]:SIGMA[,SIGMA..]; an InputError names it.

    Args:
        owners: names of stations, and of cameras. quantities: possible quantities of a station and of a camera.
    """
    where = f"--prior {spec!r}"
    left, equals, right = spec.rpartition("=")
    values, colon, sigmas = right.partition(":")
    if not (equals and colon):
        raise InputError(f"{where}: write OWNER.NAME=VALUE:SIGMA, such as {PRIOR_EXAMPLE}")
    name, _, quantity = left.strip().rpartition(".")
    owner = next((one for one, known in quantities.items() if quantity in known), "")
    if not owner:
        meant = did_you_mean(quantity, [one for known in quantities.values() for one in known])
        known = ", ".join(f"a {one} has {', '.join(names)}" for one, names in quantities.items())
        raise InputError(f"{where}: there is no quantity {quantity!r}{meant or f': {known}'}")
    parse = parse_lengths if quantity.endswith("_m") else parse_numbers
    sigma = parse(sigmas, f"{where}: sigma")
    if min(sigma) <= 0.0:
        raise InputError(f"{where}: sigma must be above 0")
    name = name if name or len(owners[owner]) != 1 else next(iter(owners[owner]))
    if name not in owners[owner]:
        raise InputError(f"{where}: name one {owner} before the dot: {', '.join(owners[owner])}")
    spread = {"sigma_m" if owner == "station" else "sigma": sigma[0] if len(sigma) == 1 else list(sigma)}
    return observations.prior_from_json({owner: name, quantity: list(parse(values, where)), **spread}, where)


def parse_priors(specs: Sequence[str], owners: Mapping[str, Collection[str]], options: Options) -> list[Prior]:
    """Parse `--prior` arguments, given the other options of `calibrate`."""
    quantities = {"station": ("height_m", "position_m"), "camera": (*options.intrinsic_names, "principal_point")}
    return [parse_prior(spec, owners, quantities) for spec in specs]


def parse_estimates(specs: Sequence[str], targets: Mapping[str, scene.Target]) -> tuple[Prior, ...]:
    """Parse `--estimate` arguments, [TARGET.]NAME[=VALUE[:SIGMA]],...: priors on dimensions of targets.

    Raises:
        InputError: a dimension that no target has, several have, or that is given twice.
    """
    every = [_parsed(part, targets) for spec in specs for part in parse_names(spec)]
    for number, prior in enumerate(every):
        if prior.dimension in {one.dimension for one in every[:number]}:
            raise InputError(f"--estimate: {prior.quantity} is given twice")
    return tuple(every)


def _parsed(text: str, targets: Mapping[str, scene.Target]) -> Prior:
    from ceres_cal.observations import Prior
    from ceres_cal.problem.quantities import dimension_range

    where = f"--estimate {text!r}"
    left, equals, right = text.partition("=")
    value, colon, sigma = right.partition(":")
    owner, _, word = left.strip().rpartition(".")
    found = [(name, one) for name in targets if owner in ("", name) for one in _meant(word, targets[name].dimensions)]
    if len(found) != 1:
        names = [one for name in targets if owner in ("", name) for one in targets[name].dimensions]
        said = f"may be {' or '.join(one for _, one in found)}" if found else "is not a dimension"
        raise InputError(f"{where}: {word!r} {said}: there are {', '.join(names) or 'none'}")
    ((name, dimension),) = found
    drawn_m = targets[name].dimensions[dimension]
    length = parse_length(value, where) if equals else drawn_m
    dimension_range(drawn_m).require(length, f"{where}: {dimension}")
    sd = parse_length(sigma, f"{where}: sigma") if colon else float("inf")
    return Prior("target", name, dimension, (length,), (sd,))


def _meant(word: str, dimensions: Mapping[str, float]) -> Iterator[str]:
    """Yield the dimensions that a word may mean: its own or the field's, else all whose names contain it."""
    asked = word.strip().lower().replace("-", "_").removesuffix("_m")
    own = [name for name in dimensions if name.removesuffix("_m") in (asked, f"field_{asked}")]
    parts = set(asked.split("_"))
    yield from own or (name for name in dimensions if asked and parts <= set(name.split("_")))
