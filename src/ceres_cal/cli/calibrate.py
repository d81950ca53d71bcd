"""`ceres-cal calibrate`: the main job."""

from __future__ import annotations

from argparse import ArgumentParser, ArgumentTypeError, Namespace
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

from ceres_cal.base.errors import InputError
from ceres_cal.cli.arguments import (
    PRIOR_EXAMPLE,
    PriorNames,
    add_output,
    add_quiet,
    add_report,
    parse_number,
    parse_prior,
)
from ceres_cal.cli.command import Answer, Command
from ceres_cal.cli.inputs import read_observations, require_different
from ceres_cal.cli.outputs import report_page, report_photographs, require_outputs, write_results
from ceres_cal.cli.progress import ProgressBar, progress_bar

if TYPE_CHECKING:
    from ceres_cal.model.parameters import Options
    from ceres_cal.model.structure import Tolerance
    from ceres_cal.observations import Observations
    from ceres_cal.solve import Progress


_DEFAULT_LENS, _AUTO = "radial", "auto"


def _lens_kind(name: str) -> str:
    """A kind of lens that is in the table; the default is, and help and wrong usage need no table."""
    if name not in (_DEFAULT_LENS, _AUTO):
        from ceres_cal.scene.lens import LENSES

        if name not in LENSES:
            raise ArgumentTypeError(f"invalid choice: {name!r} (choose from {', '.join(map(repr, (*LENSES, _AUTO)))})")
    return name


def _add_arguments(parser: ArgumentParser) -> None:
    parser.add_argument(
        "observations", nargs="+", metavar="OBS", help="files of observations (.json or .npz), taken together"
    )
    add_output(parser, "the calibration", required=False)
    add_report(parser)
    _add_camera(parser)
    _add_solve(parser)
    add_quiet(parser)


def _add_camera(parser: ArgumentParser) -> None:
    add = parser.add_argument_group("the camera").add_argument
    kinds = (
        "radial (the paper's), brown (OpenCV's), kannala-brandt (its fisheye), ...: `--lens ?` names all; auto: the "
        "simplest of all that predicts views as well as any other"
    )
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
        f"coefficient of a camera, such as {PRIOR_EXAMPLE} or phi=812:5 (the owner may be left out where there is "
        "only one); repeatable",
    )


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


def _run(args: Namespace) -> Answer:
    require_outputs(args, args.observations)
    require_different(args.observations)
    fixed, powers = _fixed(args.fix), _powers(args)
    from ceres_cal.cli.summary import calibration_data, calibration_text

    observations = read_observations(args.observations)
    photographs = report_photographs(args, observations)
    options = _options(args, fixed, powers, observations)
    with progress_bar(args) as bar:
        from ceres_cal.calibrating import calibrate
        from ceres_cal.report.quality import quality_of

        calibration = calibrate(observations, options, _solve_progress(bar, options.max_iterations))
        if args.report is not None:
            bar.update(0, 1, "drawing the report")
        page = report_page(args, calibration, observations, photographs)
        quality = quality_of(calibration, observations)
    write_results(args, calibration.save, page)
    return Answer(
        calibration_data(quality, args.observations, args), lambda: calibration_text(quality, args.observations, args)
    )


COMMANDS = (Command("calibrate", "calibrate cameras from observations of fields and boards", _add_arguments, _run),)


def _solve_progress(bar: ProgressBar, most: int) -> Callable[[Progress], None]:
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
    from ceres_cal.model.parameters import Options

    options = Options(lens=args.lens, powers=powers, fixed=fixed)
    names = PriorNames(("height_m", "position_m"), (*options.intrinsic_names, "principal_point"))
    return Options(
        lens=args.lens,
        powers=powers,
        free_principal_point=not args.hold_principal_point,
        free_aspect=args.free_aspect,
        fixed=fixed,
        priors=tuple(parse_prior(spec, observations, names) for spec in args.prior),
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
