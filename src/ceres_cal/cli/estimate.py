"""`--estimate`: dimensions of targets that are not known, as people type them."""

from __future__ import annotations

from argparse import ArgumentParser
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

from ceres_cal.base.errors import InputError
from ceres_cal.cli.arguments import parse_length, parse_names

if TYPE_CHECKING:
    from ceres_cal.observations import Prior
    from ceres_cal.scene.targets import Target

_EXAMPLE = "length,width"


def add_estimate(parser: ArgumentParser) -> None:
    """The option --estimate."""
    parser.add_argument(
        "--estimate",
        metavar="NAME,...",
        action="append",
        default=[],
        help=f"dimensions of the field that are not known and solved for, such as {_EXAMPLE}: one length of it, or a "
        "height, must be known; width=5.5 says where to start, width=5.50:20mm how well it is known; repeatable",
    )


def parse_estimates(specs: Sequence[str], targets: Mapping[str, Target]) -> tuple[Prior, ...]:
    """What is known of dimensions of targets by `--estimate` arguments: [TARGET.]NAME[=VALUE[:SIGMA]],...

    Raises:
        InputError: what no target has, several have, or is given twice.
    """
    every = [_parsed(part, targets) for spec in specs for part in parse_names(spec)]
    for number, prior in enumerate(every):
        if prior.dimension in {one.dimension for one in every[:number]}:
            raise InputError(f"--estimate: {prior.quantity} is given twice")
    return tuple(every)


def _parsed(text: str, targets: Mapping[str, Target]) -> Prior:
    from ceres_cal.observations import Prior

    where = f"--estimate {text!r}"
    left, equals, right = text.partition("=")
    value, colon, sigma = right.partition(":")
    owner, _, word = left.strip().rpartition(".")
    found = [(name, one) for name in targets if owner in ("", name) for one in _meant(word, targets[name].dimensions)]
    if len(found) != 1:
        names = [one for name in targets if owner in ("", name) for one in targets[name].dimensions]
        said = f"may be {' or '.join(one for _, one in found)}" if found else "is no dimension"
        raise InputError(f"{where}: {word!r} {said}: there are {', '.join(names) or 'none'}")
    ((name, dimension),) = found
    length = parse_length(value, where) if equals else targets[name].dimensions[dimension]
    sd = parse_length(sigma, f"{where}: sigma") if colon else float("inf")
    return Prior("target", name, dimension, (length,), (sd,))


def _meant(word: str, dimensions: Mapping[str, float]) -> Iterator[str]:
    """The dimensions that a word may mean: itself, the field's own, else all that have it in their names."""
    asked = word.strip().lower().replace("-", "_").removesuffix("_m")
    own = [name for name in dimensions if name.removesuffix("_m") in (asked, f"field_{asked}")]
    parts = set(asked.split("_"))
    yield from own or (name for name in dimensions if asked and parts <= set(name.split("_")))
