"""`ceres-cal calibrate`: the main job."""

from __future__ import annotations

from argparse import ArgumentParser, ArgumentTypeError, Namespace
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING, Any

from ceres_cal.base.errors import InputError
from ceres_cal.cli.arguments import (
    PriorNames,
    add_output,
    add_prior,
    add_quiet,
    add_report,
    parse_length,
    parse_names,
    parse_number,
    parse_prior,
)
from ceres_cal.cli.command import Answer, Command
from ceres_cal.cli.estimate import add_estimate, parse_estimates
from ceres_cal.cli.inputs import read_observations, require_different
from ceres_cal.cli.outputs import report_page, report_photographs, require_outputs, write_results
from ceres_cal.cli.progress import ProgressBar, progress_bar

if TYPE_CHECKING:
    from ceres_cal.model.parameters import Options
    from ceres_cal.model.structure import Tolerance
    from ceres_cal.observations import Observations
    from ceres_cal.solve import Progress


_AUTO = "auto"
_PATIENCE_S = 5.0  # with a scheduler
_TERMS = (
    "rational (OpenCV's k4 to k6) and prism (its s1 to s4) of brown, tangential (p1, p2) of kannala-brandt, "
    "surface (nodes over the picture) of spline"
)


def _lens_kind(name: str) -> str:
    """A kind of lens that is in the table; the default needs none, nor do help and wrong usage."""
    if name != _AUTO:
        from ceres_cal.scene.lens import LENSES

        if name not in LENSES:
            raise ArgumentTypeError(f"invalid choice: {name!r} (choose from {', '.join(map(repr, (*LENSES, _AUTO)))})")
    return name


def _add_arguments(parser: ArgumentParser) -> None:
    parser.add_argument(
        "observations",
        nargs="+",
        metavar="OBS",
        help="files of observations (.json or .npz, or one folder .columns), taken together",
    )
    add_output(parser, "the calibration", required=False)
    add_report(parser)
    _add_camera(parser)
    _add_solve(parser)
    add_quiet(parser)


def _add_camera(parser: ArgumentParser) -> None:
    add = parser.add_argument_group("the camera").add_argument
    kinds = (
        "radial (the paper's), brown (OpenCV's), kannala-brandt (its fisheye), spline (no formula), ...: `--lens ?` "
        "names all; default: auto, the simplest of all with a formula that predicts views as well as any other"
    )
    add("--lens", type=_lens_kind, metavar="KIND", help=kinds)
    add(
        "--powers",
        metavar="2,3",
        help="of a lens that leaves the choice; of one that is named default: 2,3, the paper's, of "
        "spline then more as the residuals ask for",
    )
    add("--terms", metavar="NAME,...", default="", help="terms that a lens may have besides: " + _TERMS)
    add(
        "--fix",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="hold phi, aspect, cx, cy, skew or a coefficient, such as k3=0; repeatable",
    )
    add("--free-aspect", action="store_true", help="let fy / fx differ from 1")
    add("--free-skew", action="store_true", help="let the pixels' columns lean against their rows")
    add("--no-usual-camera", action="store_true", help="nothing is taken for usual of the principal point")
    add("--hold-principal-point", action="store_true", help="hold it at the image's centre")
    add(
        "--tolerance",
        metavar="SPEC",
        action="append",
        default=[],
        help="solve for a target as built: field.lines_m=0.01, field.points_m=0.005 or board.warp_m=0.002 "
        "(a sigma in metres, or such as 10mm; repeatable)",
    )
    add(
        "--as-built",
        action="store_true",
        help="solve for corners, bows and lines whose residuals repeat over the views, with a sigma from the data; "
        "else targets without a tolerance are taken as drawn",
    )
    add_prior(parser)
    add_estimate(parser)


def _add_solve(parser: ArgumentParser) -> None:
    add = parser.add_argument_group("the solve").add_argument
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
    add("--scheduler", metavar="ADDRESS", help="of Dask, whose workers keep the observations, such as tcp://host:8786")


def _run(args: Namespace) -> Answer:
    require_outputs(args, args.observations)
    require_different(args.observations)
    fixed, powers = _fixed(args.fix), _powers(args)
    from ceres_cal.cli.summary import calibration_data, calibration_text

    observations = read_observations(args.observations)
    photographs = report_photographs(args, observations)
    options = _options(args, fixed, powers, observations)
    with progress_bar(args) as bar, _client(args.scheduler) as client:
        from ceres_cal.calibrating import calibrate
        from ceres_cal.report.quality import quality_of

        workers = {} if client is None else {"client": client}
        calibration = calibrate(observations, options, _solve_progress(bar), **workers)
    page = report_page(args, calibration, observations, photographs)
    quality = quality_of(calibration, observations)
    write_results(args, calibration.save, page)
    return Answer(
        calibration_data(quality, args.observations, args), lambda: calibration_text(quality, args.observations, args)
    )


def _client(address: str | None) -> AbstractContextManager[Any]:
    """Of the scheduler there, whose answer is awaited for some seconds; nothing without an address."""
    if address is None:
        return nullcontext()
    try:
        from distributed import Client
    except ImportError:
        raise InputError("--scheduler needs Dask: pip install 'ceres-cal[dask]'") from None
    try:
        client: AbstractContextManager[Any] = Client(address, timeout=_PATIENCE_S)
    except (OSError, ValueError) as error:
        raise InputError(f"--scheduler {address}: no scheduler answers there ({str(error).splitlines()[0]})") from None
    return client


COMMANDS = (
    Command(
        "calibrate",
        "calibrate cameras from observations of fields and boards",
        _add_arguments,
        _run,
        (
            "field.json board.json -o calibration.json --report report.html",
            "field.json --lens auto --prior height_m=4.02:10mm -o calibration.json",
            "field.json --powers 3 --tolerance field.lines_m=10mm -o calibration.json",
            "field.json --estimate length,width=5.50:20mm -o calibration.json",
        ),
    ),
)


def _solve_progress(bar: ProgressBar) -> Callable[[Progress], None]:
    """The solver's callback; a solve begins with its iteration 0."""
    solves = 0

    def show(progress: Progress) -> None:
        nonlocal solves
        solves += progress.iteration == 0
        note = f"solve {solves}, iteration {progress.iteration}, cost {progress.cost:.6g}"
        bar.update(progress.iteration, 0, note)  # after how many it comes to rest nobody knows

    return show


# ---- options as they are typed --------------------------------------------------------------------------------------


def _powers(args: Namespace) -> tuple[int, ...]:
    if args.powers is None:
        return ()
    from ceres_cal.scene.lens import LENSES

    choosing = [kind for kind, lens in LENSES.items() if lens.trial_powers]
    if args.lens not in (None, *choosing):
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
    from ceres_cal.model.dimensions import dimensions_of
    from ceres_cal.model.parameters import Options

    lens = args.lens or _AUTO  # which powers make radial
    terms = tuple(parse_names(args.terms))
    options = Options(lens=lens, powers=powers, terms=terms, fixed=fixed)
    lengths, drawn = parse_estimates(args.estimate, observations.targets), dimensions_of(observations.targets)
    names = PriorNames(("height_m", "position_m"), (*options.intrinsic_names, "principal_point"))
    return Options(
        lens=lens,
        powers=powers,
        free_principal_point=not args.hold_principal_point,
        free_aspect=args.free_aspect,
        free_skew=args.free_skew,
        terms=terms,
        usual_camera=not args.no_usual_camera,
        fixed=fixed,
        priors=(
            *(parse_prior(spec, observations, names) for spec in args.prior),
            *(one for one in lengths if not one.is_open or one.value[0] != drawn[one.dimension]),
        ),
        dimensions=tuple(prior.dimension for prior in lengths),
        tolerances=_tolerances(args.tolerance),
        as_built="estimate" if args.as_built else "as drawn",
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

    given: dict[str, dict[str, Any]] = {}
    names = ("lines_m", "points_m", "warp_m")
    for spec in specs:
        left, equals, value = spec.rpartition("=")
        target, dot, what = left.strip().rpartition(".")
        if not (equals and dot) or what not in names:
            raise InputError(f"--tolerance {spec!r}: write TARGET.{'|'.join(names)}=SIGMA, such as field.lines_m=0.01")
        given.setdefault(target, {})[what] = parse_length(value, f"--tolerance {spec!r}")
    return {target: Tolerance(**sigmas) for target, sigmas in given.items()}
