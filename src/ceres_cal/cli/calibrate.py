"""`ceres-cal calibrate`: calibration of cameras from files of observations."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from ceres_cal import diagnostics, scene
from ceres_cal.base import InputError, naming, replace
from ceres_cal.cli import arguments, files
from ceres_cal.cli.command import argument, command, option, switch, whole
from ceres_cal.cli.terminal import ProgressBar
from ceres_cal.report.document import Document

if TYPE_CHECKING:
    from ceres_cal.observations import Observations
    from ceres_cal.problem import Options, Progress, SolveProgress, Tolerance


_AUTO = "auto"
_CAMERA, _SOLVE = "the camera", "the solve"
_camera, _solve = (partial(option, group=group) for group in (_CAMERA, _SOLVE))
_camera_switch, _solve_switch = (partial(switch, group=group) for group in (_CAMERA, _SOLVE))


def _lens_kind(name: str) -> str:
    """Check a kind of lens against the table, which is not imported for the default, for help or for wrong usage."""
    if name != _AUTO:
        with naming("--lens"):
            scene.lens_class(name, also=(_AUTO,))
    return name


class CalibrateArguments(arguments.ReportArguments):
    """Arguments of `calibrate`: what is estimated and how. Those with names of `Options` are passed on unchanged."""

    observations: tuple[str, ...] = argument(
        "OBS", "files of observations (.json, .npz, or one folder .columns); several are taken together"
    )
    output: Path | None = arguments.output_option("the calibration", None)
    lens: str | None = _camera(
        "lens model: radial (a polynomial of the radius), brown (OpenCV's), kannala-brandt (OpenCV's fisheye), spline "
        "(no formula), ...: `--lens ?` names all; default: auto, the simplest with a formula that predicts held-out "
        "views as well as any other",
        "KIND",
        read=_lens_kind,
    )
    powers: str | None = _camera(
        "powers of the radius in the radial and spline lenses; default: chosen with --lens auto, else 2,3, to which "
        "spline adds more where the residuals require it",
        "2,3",
    )
    terms: str = _camera(
        "further terms of the lens: rational (OpenCV's k4 to k6) and prism (its s1 to s4) of brown, tangential (p1, "
        "p2) of kannala-brandt, surface (displacements on a grid over the picture) of spline",
        "NAME,...",
        "",
    )
    fix: tuple[str, ...] = _camera(
        "hold phi (the focal length in px), aspect (fy / fx), cx, cy (the principal point in px), skew or a "
        "coefficient of the lens at a value, such as k3=0",
        "NAME=VALUE",
        repeatable=True,
    )
    free_aspect: bool | None = _camera_switch(
        "let fy / fx be anything (default: near 1, or what the observations clearly say; `--fix aspect=1` holds it)",
        default=None,
    )
    free_skew: bool = _camera_switch("solve for skew, by which columns of pixels are not perpendicular to rows")
    usual_camera: bool = _camera_switch(
        "do not assume that the camera is a usual one: any focal length, any principal point, any decentring of the "
        "lens; pixels are still taken to be square",
        default=True,
        flags=("--no-usual-camera",),
    )
    free_principal_point: bool = _camera_switch(
        "hold the principal point at the image's centre", default=True, flags=("--hold-principal-point",)
    )
    tolerance: tuple[str, ...] = _camera(
        "solve for a target as it was built, with a standard deviation in metres, or such as 10mm: field.lines_m=0.01, "
        "field.points_m=0.005 or board.warp_m=0.002",
        "SPEC",
        repeatable=True,
    )
    as_drawn: bool = _camera_switch(
        "take targets without a tolerance as drawn, and floors as flat and square. Default: corners, lines and bows of "
        "boards whose residuals repeat over the views are solved for, and one floor in five is assumed to be off by "
        "2 mm over 9 m",
    )
    as_built: bool = _camera_switch("solve for targets as they were built: the default")
    prior: tuple[str, ...] = arguments.prior_option(group=_CAMERA)
    estimate: tuple[str, ...] = arguments.estimate_option(group=_CAMERA)
    mend_labels: bool = _solve_switch(
        "where features were observed under the name of another feature, correct the names and calibrate again; "
        "default: say which they are",
    )
    loss: arguments.Loss = _solve("robust loss", default="huber")
    loss_scale: float = _solve("residual, in standard deviations, from which an observation counts less", "SIGMA", 2.5)
    reject_sigma: float = _solve(
        "observations that are more standard deviations off are taken out and listed", "SIGMA", 5.0
    )
    noise_scale: Literal["estimate", "stated"] = _solve(
        "estimate the noise of points and of curves from their residuals (default), or keep the stated sigmas",
        default="estimate",
    )
    closed_form_only: bool = _solve_switch(
        "stop at the closed forms of R. Rojas's paper: a baseline to compare with, not a calibration"
    )
    max_iterations: int = _solve("most iterations of each solve", "N", 100, read=whole(1))
    threads: int = _solve(
        "most threads; default: 0, where the solver chooses", "N", 0, read=whole(0), elsewhere=("jobs",)
    )
    scheduler: str | None = _solve(
        "a Dask scheduler, whose workers keep the observations, such as tcp://host:8786", "ADDRESS"
    )


@command(
    "calibrate",
    "calibrate cameras from observations of fields and boards",
    "field.json board.json -o calibration.json --report report.html",
    "field.json --lens auto --prior height_m=4.02:10mm -o calibration.json",
    "field.json --powers 3 --tolerance field.lines_m=10mm -o calibration.json",
    "field.json --estimate length,width=5.50:20mm -o calibration.json",
)
def _run(args: CalibrateArguments) -> Document:
    files.require_outputs(args, args.observations)
    files.require_different(args.observations)
    fixed = arguments.named_values("--fix", "NAME=VALUE, such as k3=0", arguments.parse_number, args.fix)
    powers = _powers(args)  # errors of usage are raised before anything is read
    observations = files.read_observations(args.observations)
    photographs = files.report_photographs(args, observations)
    options = _options(args, observations, fixed=fixed, powers=powers)
    with ProgressBar(args.silent) as bar, _client(args.scheduler) as client:
        from ceres_cal.calibration.calibrating import calibrate

        workers = {} if client is None else {"client": client}
        renaming = None
        if args.mend_labels:
            from ceres_cal.calibration.renaming import find_renaming

            renaming = find_renaming(observations, options)
        observations = renaming.corrected(observations) if renaming else observations
        calibration = calibrate(observations, options, _solve_progress(bar), **workers)
        wrong = tuple(diagnostics.renamings(observations, calibration)) if calibration.rounds else ()
        if wrong and args.mend_labels:
            observations = diagnostics.mended(observations, wrong)
            calibration = calibrate(observations, options, _solve_progress(bar), **workers)
    done = "renamed" if args.mend_labels else "taken out; --mend-labels corrects the name"
    found = [*([renaming.words] if renaming else []), *(diagnostics.renaming_words(one, observations) for one in wrong)]
    # Remarks, which cost no trust: beside features that were taken out, the others were as accurate as stated.
    calibration = replace(calibration, remarks=(*calibration.remarks, *(f"{words}: {done}" for words in found)))
    return files.calibrated(args, calibration, observations, photographs, args.observations)


def _client(address: str | None) -> AbstractContextManager[Any]:
    """Connect to the scheduler at an address, waiting some seconds for its answer; no client without an address."""
    patience_s = 5.0  # time to wait for a scheduler
    if address is None:
        return nullcontext()
    try:
        from distributed import Client
    except ImportError:
        raise InputError("--scheduler needs Dask: pip install 'ceres-cal[dask]'") from None
    try:
        client: AbstractContextManager[Any] = Client(address, timeout=patience_s)
    except (OSError, ValueError) as error:
        raise InputError(f"--scheduler {address}: no scheduler answers there ({str(error).splitlines()[0]})") from None
    return client


def _solve_progress(bar: ProgressBar) -> SolveProgress:
    """Return the solver's callback; a solve begins with its iteration 0."""
    solves = 0

    def show(progress: Progress) -> None:
        nonlocal solves
        solves += progress.iteration == 0
        note = f"solve {solves}, iteration {progress.iteration}, cost {progress.cost:.6g}"
        bar.update(progress.iteration, 0, note)  # the number of iterations until convergence is unknown

    return show


# ---- options as they are typed --------------------------------------------------------------------------------------


def _powers(args: CalibrateArguments) -> tuple[int, ...]:
    if args.powers is None:
        return ()

    choosing = [kind for kind, lens in scene.LENSES.items() if lens.trial_powers]
    if args.lens not in (None, *choosing):
        raise InputError(f"--powers is for the {' or '.join(choosing)} lens, not for {args.lens}: leave it out")
    try:
        return tuple(int(power) for power in args.powers.split(","))
    except ValueError:
        raise InputError(f"--powers {args.powers!r}: give whole numbers between commas, such as 2,3") from None


def _options(args: CalibrateArguments, observations: Observations, **parsed: Any) -> Options:
    """Make the options; `parsed`: powers and fixed numbers."""
    from ceres_cal.problem import Options, dimensions_of

    terms = tuple(arguments.parse_names(args.terms))
    parsed |= {"lens": args.lens or _AUTO, "terms": terms}  # with powers alone the lens is radial
    lengths, drawn = arguments.parse_estimates(args.estimate, observations.targets), dimensions_of(observations.targets)
    owners = {"station": observations.stations, "camera": observations.cameras}
    priors = arguments.parse_priors(args.prior, owners, Options(**parsed))
    priors += [one for one in lengths if not one.is_open or one.value[0] != drawn[one.dimension]]
    parsed |= {
        "priors": tuple(priors),
        "dimensions": tuple(prior.dimension for prior in lengths),
        "tolerances": _tolerances(args.tolerance),
        "as_built": "as drawn" if args.as_drawn and not args.as_built else "estimate",
    }
    same = {one.name for one in fields(Options)} & vars(args).keys() - parsed.keys()
    return Options(**{name: getattr(args, name) for name in same}, **parsed)


def _tolerances(specs: Sequence[str]) -> dict[str, Tolerance]:
    """Parse `--tolerance` arguments: TARGET.lines_m|points_m|warp_m|heights_m|stretch_m=SIGMA."""
    from ceres_cal.problem.structure import Tolerance

    given: dict[str, dict[str, Any]] = {}
    names = ("lines_m", "points_m", "warp_m", "heights_m", "stretch_m")
    for spec in specs:
        left, equals, value = spec.rpartition("=")
        target, dot, what = left.strip().rpartition(".")
        if not (equals and dot) or what not in names:
            raise InputError(f"--tolerance {spec!r}: write TARGET.{'|'.join(names)}=SIGMA, such as field.lines_m=0.01")
        given.setdefault(target, {})[what] = arguments.parse_length(value, f"--tolerance {spec!r}")
    return {target: Tolerance(**sigmas) for target, sigmas in given.items()}
