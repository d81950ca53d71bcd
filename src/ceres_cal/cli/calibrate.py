"""`ceres-cal calibrate`: the main job."""

from __future__ import annotations

from argparse import ArgumentParser, ArgumentTypeError, Namespace
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from ceres_cal.base.errors import InputError
from ceres_cal.cli.album import album_of
from ceres_cal.cli.command import (
    Answer,
    Command,
    add_output,
    add_report,
    finishing,
    parse_number,
    parse_numbers,
    require_outputs,
)
from ceres_cal.cli.progress import ProgressBar

if TYPE_CHECKING:
    from ceres_cal.calibration import Calibration
    from ceres_cal.model.parameters import Options
    from ceres_cal.model.structure import Tolerance
    from ceres_cal.observations import Observations, Prior
    from ceres_cal.report import Album
    from ceres_cal.solve import Progress

_STATION_QUANTITIES = ("height_m", "position_m")
_PRIOR_EXAMPLE = "overhead.height_m=4.02:0.01"


_DEFAULT_LENS = "radial"


def _lens_kind(name: str) -> str:
    """A kind of lens that is in the table; the default is, and help and wrong usage need no table."""
    if name != _DEFAULT_LENS:
        from ceres_cal.scene.lens import LENSES

        if name not in LENSES:
            raise ArgumentTypeError(f"invalid choice: {name!r} (choose from {', '.join(map(repr, LENSES))})")
    return name


def _add_arguments(parser: ArgumentParser) -> None:
    add = parser.add_argument
    add("observations", nargs="+", metavar="OBS", help="files of observations (.json or .npz), taken together")
    add_output(parser, "the calibration", required=False)
    add_report(parser)
    lens = parser.add_argument_group("the camera")
    add = lens.add_argument
    kinds = "radial (the paper's), brown (OpenCV's), kannala-brandt (its fisheye), ...: `--lens ?` names all"
    add("--lens", type=_lens_kind, metavar="KIND", default=_DEFAULT_LENS, help=kinds)
    add("--powers", metavar="2,3", help="powers of a lens that leaves the choice; default: 2,3, the paper's")
    add(
        "--fix",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="hold phi, aspect, cx, cy or a coefficient, such as k3=0; repeatable",
    )
    add("--free-aspect", action="store_true", help="let fy / fx differ from 1")
    add("--hold-principal-point", action="store_true", help="hold it at the image's centre")
    add(
        "--tolerance",
        metavar="SPEC",
        action="append",
        default=[],
        help="solve for a target as built: field.lines_m=0.01, field.points_m=0.005 or board.warp_m=0.002 "
        "(a sigma in metres; repeatable)",
    )
    add(
        "--prior",
        action="append",
        default=[],
        metavar="OWNER.NAME=VALUE:SIGMA",
        help="what is known beforehand: height_m or position_m of a station, phi, principal_point, aspect or a "
        f"coefficient of a camera, such as {_PRIOR_EXAMPLE} or phi=812:5 (the owner may be left out where there is "
        "only one); repeatable",
    )
    solve = parser.add_argument_group("the solve")
    add = solve.add_argument
    add("--loss", choices=("trivial", "huber", "soft_l1", "cauchy", "tukey"), default="huber", help="default: huber")
    add("--loss-scale", type=float, default=2.5, metavar="SIGMA", help="where the loss starts to bend; default: 2.5")
    add(
        "--reject-sigma",
        type=float,
        default=5.0,
        metavar="SIGMA",
        help="observations farther off are taken out and listed; default: 5",
    )
    add(
        "--noise-scale",
        choices=("estimate", "stated"),
        default="estimate",
        help="estimate the noise of points and of curves from their residuals (default), or keep the stated sigmas",
    )
    add(
        "--closed-form-only",
        action="store_true",
        help="stop at the paper's own method: a baseline to compare with, not a calibration",
    )
    add("--max-iterations", type=int, default=100, metavar="N", help="of each solve; default: 100")
    add("--threads", type=int, default=0, metavar="N", help="default: the solver chooses")
    parser.add_argument("--quiet", action="store_true", help="no progress")


def _run(args: Namespace) -> Answer:
    require_outputs(args.output, args.report, args.observations)
    require_different(args.observations)
    fixed, powers = _fixed(args.fix), _powers(args)
    from ceres_cal.base.files import write_bytes
    from ceres_cal.cli.summary import calibration_data, calibration_text
    from ceres_cal.observations import Observations, combine

    observations = combine([Observations.load(path) for path in args.observations])
    album = album_of(args, observations)
    options = _options(args, fixed, powers, observations)
    with ProgressBar(silent=args.quiet or args.json) as bar:
        from ceres_cal.kernels.jit import CACHE_FOLDER

        if next(CACHE_FOLDER.rglob("*.nbi"), None) is None:
            bar.say("compiling the kernels (first run only)")
        from ceres_cal.calibrating import calibrate

        calibration = calibrate(observations, options, _shown_on(bar, options.max_iterations))
        page = _page(calibration, observations, album, bar) if args.report is not None else ""
    with finishing():
        if args.output is not None:
            calibration.save(args.output)
        if args.report is not None:
            write_bytes(args.report, page.encode())
    return Answer(
        calibration_data(calibration, observations, args.observations, args.output, args.report),
        lambda: calibration_text(calibration, observations, args.observations, args.output, args.report),
    )


def _page(calibration: Calibration, observations: Observations, album: Album | None, bar: ProgressBar) -> str:
    from ceres_cal.report import make_report

    bar.update(0, 1, "drawing the report")
    return make_report(calibration, observations, album=album)


COMMANDS = (Command("calibrate", "calibrate cameras from observations of fields and boards", _add_arguments, _run),)


def require_different(files: list[str]) -> None:
    """A file that counts twice would make its observations look better than they are."""
    places = [Path(file).resolve() for file in files]
    for file, place in zip(files, places, strict=True):
        if places.count(place) > 1:
            raise InputError(f"{file}: given twice: name every file once")


def _shown_on(bar: ProgressBar, most: int) -> Callable[[Progress], None]:
    """The solver's callback; a solve begins with its iteration 0."""
    solves = 0

    def show(progress: Progress) -> None:
        nonlocal solves
        solves += progress.iteration == 0
        note = f"solve {solves}, iteration {progress.iteration}, cost {progress.cost:.6g}"
        bar.update(progress.iteration, most, note)

    return show


# ---- options as they are typed --------------------------------------------------------------------------------------


def _powers(args: Namespace) -> tuple[int, ...]:
    if args.powers is None:
        return (2, 3)
    from ceres_cal.scene.lens import LENSES

    choosing = [kind for kind, lens in LENSES.items() if lens.trial_powers]
    if args.lens not in choosing:
        raise InputError(f"--powers is for the {' or '.join(choosing)} lens, not for {args.lens}: leave it out")
    try:
        return tuple(int(power) for power in args.powers.split(","))
    except ValueError:
        raise InputError(f"--powers {args.powers!r}: give whole numbers between commas, such as 2,3") from None


def _fixed(specs: list[str]) -> dict[str, float]:
    fixed: dict[str, float] = {}
    for spec in specs:
        name, equals, value = spec.partition("=")
        if not equals:
            raise InputError(f"--fix {spec!r}: write NAME=VALUE, such as k3=0")
        if name.strip() in fixed:
            raise InputError(f"--fix {spec!r}: {name.strip()} is fixed twice")
        fixed[name.strip()] = parse_number(value, f"--fix {spec!r}")
    return fixed


def _options(
    args: Namespace, fixed: Mapping[str, float], powers: tuple[int, ...], observations: Observations
) -> Options:
    from ceres_cal.model.parameters import Options, intrinsic_names

    options = Options(lens=args.lens, powers=powers, fixed=fixed)
    quantities = (*intrinsic_names(options.blank_lens), "principal_point")
    return Options(
        lens=args.lens,
        powers=powers,
        free_principal_point=not args.hold_principal_point,
        free_aspect=args.free_aspect,
        fixed=fixed,
        priors=tuple(_prior(spec, observations, quantities) for spec in args.prior),
        tolerances=_tolerances(args.tolerance),
        loss=args.loss,
        loss_scale=args.loss_scale,
        reject_sigma=args.reject_sigma,
        noise_scale=args.noise_scale,
        closed_form_only=args.closed_form_only,
        max_iterations=args.max_iterations,
        threads=args.threads,
    )


def _tolerances(specs: list[str]) -> dict[str, Tolerance]:
    """The tolerances of `--tolerance` arguments: TARGET.lines_m|points_m|warp_m=SIGMA."""
    from ceres_cal.model.structure import Tolerance

    given: dict[str, dict[str, float]] = {}
    for spec in specs:
        left, equals, value = spec.rpartition("=")
        target, dot, what = left.strip().rpartition(".")
        names = tuple(Tolerance.__dataclass_fields__)
        if not (equals and dot) or what not in names:
            raise InputError(f"--tolerance {spec!r}: write TARGET.{'|'.join(names)}=SIGMA, such as field.lines_m=0.01")
        given.setdefault(target, {})[what] = parse_number(value, f"--tolerance {spec!r}")
    return {target: Tolerance(**sigmas) for target, sigmas in given.items()}


def _prior(spec: str, observations: Observations, camera_quantities: tuple[str, ...]) -> Prior:
    """The prior of a `--prior` argument: [OWNER.]QUANTITY=VALUE[,VALUE..]:SIGMA[,SIGMA..]."""
    from ceres_cal.observations import prior_from_json

    where = f"--prior {spec!r}"
    left, equals, right = spec.rpartition("=")
    values, colon, sigmas = right.partition(":")
    if not (equals and colon):
        raise InputError(f"{where}: write OWNER.NAME=VALUE:SIGMA, such as {_PRIOR_EXAMPLE}")
    owner, _, quantity = left.strip().rpartition(".")
    if quantity not in (*_STATION_QUANTITIES, *camera_quantities):
        raise InputError(
            f"{where}: {quantity!r} is unknown: a station has {', '.join(_STATION_QUANTITIES)}, "
            f"a camera {', '.join(camera_quantities)}"
        )
    of_station = quantity in _STATION_QUANTITIES
    kind, known = ("station", tuple(observations.stations)) if of_station else ("camera", tuple(observations.cameras))
    if not owner and len(known) == 1:
        owner = known[0]
    if owner not in known:
        raise InputError(f"{where}: name one {kind} before the dot: {', '.join(known)}")
    sigma = parse_numbers(sigmas, f"{where}: sigma")
    if min(sigma) <= 0.0:
        raise InputError(f"{where}: sigma must be above 0")
    value = parse_numbers(values, where)
    return prior_from_json(
        {
            kind: owner,
            quantity: list(value),
            "sigma_m" if of_station else "sigma": sigma[0] if len(sigma) == 1 else list(sigma),
        },
        where,
    )
