"""`ceres-cal run`: from photographs to a calibration, its report and its exports, by the other commands in turn."""

from __future__ import annotations

import shlex
from collections.abc import Collection, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from ceres_cal import detect, formats, start
from ceres_cal.base import IMAGE_ENDINGS, Frozen, InputError, NothingShownError, each_camera, images_and_videos, replace
from ceres_cal.base.words import first_of, plural
from ceres_cal.cli import arguments
from ceres_cal.cli.command import COMMANDS, QuietArguments, argument, command, option
from ceres_cal.cli.files import attempted, folder_of_results, is_board, read_board, require_frames_apart, require_shown
from ceres_cal.cli.photographs import median_text, turned_section
from ceres_cal.cli.terminal import ProgressBar
from ceres_cal.report.document import Document, Section

_SHOWN = ("fit", "lens", "rig", "located", "widened", "weak", "unknown", "warning", "verdict", "error")
_MOST_NAMES = 3
_BLANK = Section("", [""])


class RunArguments(QuietArguments):
    """Inputs, and which results are wanted."""

    images: tuple[str, ...] = argument(
        "IMAGE",
        "photographs of one camera, a folder of them, or a video; of several cameras a folder or a video for each, or "
        "the folder that these are in",
    )
    output: Path = arguments.output_option("everything that is made", metavar="FOLDER")
    target: str | None = option("the field: its name, such as ssl-b, or a file, as for `detect field`", "TARGET")
    facing: tuple[str, ...] = option(
        "its orientation, as for `detect field`; of several cameras CAMERA.NAME=SIDE",
        "NAME=SIDE",
        repeatable=True,
        beside=("target",),
    )
    not_painted: str = arguments.not_painted_option("lines that this field does not have", beside=("target",))
    board: str | None = arguments.board_option(
        "a chessboard by its inner corners and the side of a square, such as 9x6x25mm; another board, of circles or "
        "AprilTags, or markers of known places, as for --target of `detect board`"
    )
    lens: str = option("lens model, as for `calibrate`", "KIND", "auto")
    prior: tuple[str, ...] = arguments.prior_option()
    estimate: tuple[str, ...] = arguments.estimate_option(beside=("target",))
    camera: str = arguments.camera_option()
    to: tuple[str, ...] = option("format of a file for another program, as for `export`", "FORMAT", repeatable=True)
    frames: int = arguments.frames_option()


class _Step(Frozen, eq=True):
    """A command as one would type it, the lines of its answer to show, the answer's data, and its exit code."""

    command: str
    lines: Sequence[str]
    data: dict[str, Any]
    exit_code: int


@command(
    "run",
    "from photographs or a video to a calibration, its report and its exports",
    "photographs/ --target ssl-b --facing LeftGoalLine=top --board 9x6x25mm -o camera/",
    "photographs/ --target ssl-b --facing LeftGoalLine=top --prior height_m=4.02:20mm --to opencv -o camera/",
    "boards.mp4 --board 9x6x25mm -o camera/",
    "cameras/ --target ssl-b --facing left.LeftGoalLine=left --facing right.LeftGoalLine=left -o field/",
)
def _run(args: RunArguments) -> Document:
    of_field = args.board or args.facing or args.not_painted or args.estimate
    if args.target is not None and is_board(args.target) and not of_field:  # other commands take a board as a target
        args = replace(args, board=args.target, target=None)
    cameras = _cameras(args)
    _require_fitting(args, cameras)
    forms = [formats.export_format(name) for name in args.to]  # raises InputError that lists the formats
    several = len(cameras) > 1
    with ExitStack() as folders:
        for one in (args, *cameras):
            folders.enter_context(folder_of_results(one.output))
        images = [_photographs(one) for one in cameras]
        seen = [_seen_by(one, own, several) for one, own in zip(cameras, images, strict=True)]
    _require_tied(cameras, seen)
    steps = [step for own in seen for step in own]
    detected = [step.data for step in steps if "output" in step.data]
    observations = [str(data["output"]) for data in detected]
    # A board that looks the same when turned by half a turn: cameras may name its corners differently.
    if several and args.board is not None and len(start.symmetries(read_board(args.board))) > 1:
        steps.append(_attempted(args, "join", [*observations, "-o", str(args.output / "rig.json")]))
        observations = [str(steps[-1].data["output"])] if steps[-1].data else observations
    calibrated = _calibrated(args, cameras, detected, observations)
    level = calibrated.data["verdict"]["level"]
    steps.append(calibrated)
    if level != "good" and args.target is not None:
        maps = (calibrated.data["uncertainty"] or {}).get("maps", {})
        least = max(maps, key=lambda name: maps[name][-1]["worst_sd_mm"], default="")  # least known of several stations
        of_one = ["--station", least] if len(maps) > 1 else []
        steps.append(_attempted(args, "advise", [str(args.output / "calibration.json"), *of_one], most=2))
    asked = [calibrated]
    if level != "no":
        asked += [step for form in forms for step in _exported(args, cameras, form)]
    steps += asked[1:]
    data = {"images": sum(map(len, images)), "verdict": calibrated.data["verdict"]}
    data["steps"] = [{"command": step.command, "answer": step.data} for step in steps]
    made = level != "no" and not any(step.exit_code for step in asked)
    sections = Section(data=data), *_sections(args, cameras, data["images"], steps, level)
    return Document(sections, 0 if made else 1, data["verdict"]["headline"])


def _cameras(args: RunArguments) -> list[RunArguments]:
    """Return the arguments for each camera: the only or named one, or one for each folder or video."""
    shown, is_named = each_camera(args.images), args.camera != RunArguments.camera
    if not shown or (is_named and len(args.images) > 1):
        return [args]
    if is_named:
        raise InputError("--camera names one camera: several are called like their folders or videos")
    names = {path: path.name if path.is_dir() else path.stem for path in shown}
    if twice := next((name for name in names.values() if list(names.values()).count(name) > 1), None):
        raise InputError(
            f"{args.images[0]}: two cameras would be called {twice!r}, like their folder or video: rename one"
        )
    prefixes = tuple(f"{name}." for name in names.values())
    of_all = [side for side in args.facing if not side.startswith(prefixes)]
    return [
        replace(
            args,
            images=(str(path),),
            output=args.output / name,
            facing=(*of_all, *(side.removeprefix(f"{name}.") for side in args.facing if side.startswith(f"{name}."))),
            camera=name,
        )
        for path, name in names.items()
    ]


def _require_tied(cameras: Sequence[RunArguments], seen: Sequence[Sequence[_Step]]) -> None:
    """Raise InputError if some folders show only boards and others only the field: nothing relates their cameras."""
    shown = [{Path(step.data["output"]).stem for step in own if "output" in step.data} for own in seen]
    alone = {kind: one.camera for kinds, one in zip(shown, cameras, strict=True) if len(kinds) == 1 for kind in kinds}
    if len(alone) > 1 and all(len(kinds) == 1 for kinds in shown):
        raise InputError(
            f"{alone['board']!r} shows boards alone and {alone['field']!r} the field alone, so these cameras are not "
            "connected: if one camera took both, name it, such as --camera overhead"
        )


def _require_fitting(args: RunArguments, cameras: Sequence[RunArguments]) -> None:
    """Raise InputError, before any photograph is read, for names, sizes and units that a later step would refuse."""
    from ceres_cal.functions import lines_to_find

    if args.target is None and args.board is None:
        raise InputError("say what the photographs show: --target ssl-b, --board 9x6x25mm, or both")
    COMMANDS["calibrate"].parse(["observations.json", "--lens", args.lens])
    names = [one.camera for one in cameras]
    for one in cameras:
        images, _ = images_and_videos(one.images)
        require_frames_apart(images)
        field = require_shown(images, args.target, args.board, args.prior, names, args.lens)
        if field is not None:
            lengths = arguments.parse_estimates(args.estimate, {"field": field})
            sides = arguments.parse_facing(one.facing)
            lines_to_find(field, sides, arguments.parse_names(args.not_painted), lengths)


# ---- the steps ------------------------------------------------------------------------------------------------------


def _step(
    args: RunArguments,
    name: str,
    arguments: Sequence[str],
    most: int | None = None,
    titles: Collection[str] | None = None,
) -> _Step:
    """Run a command; keep the first lines of its answer, and the images that showed nothing."""
    typed = COMMANDS[name].typed(arguments)
    with ProgressBar(args.silent) as bar:
        bar.say(f"now       {_short(typed)}")
    answer = COMMANDS[name].answer(arguments, quiet=args.quiet or args.json)
    missed = [f"{one['image']}: {one['reason']}" for one in answer.data.get("missed", ())]
    merged = answer.data.get("median", {})
    left_out = [median_text(merged)] if merged.get("left_out") or merged.get("shaken_px") else []
    warned = [] if most is None else answer.text({"warning"}).splitlines()
    lines = [*answer.text(titles).splitlines()[:most], *left_out, *missed, *warned]
    return _Step(typed, lines, answer.data, answer.exit_code)


def _attempted(args: RunArguments, name: str, arguments: Sequence[str], most: int | None = None) -> _Step:
    """Run a step after the calibration is made; without data where it fails, since the calibration remains valid."""
    step, unmade = attempted("advice" if name == "advise" else name, lambda: _step(args, name, arguments, most))
    return step or _Step(COMMANDS[name].typed(arguments), tuple(unmade.shown()), {}, 1)


def _photographs(args: RunArguments) -> list[Path]:
    """Return the given photographs, and those taken from videos."""
    images, videos = images_and_videos(args.images)
    with ProgressBar(args.silent) as bar:
        return [*images, *detect.frames_of_videos(videos, args.frames, args.output, bar.update)]


def _seen_by(args: RunArguments, images: list[Path], is_one_of_several: bool) -> list[_Step]:
    """Return what a camera observed; if there are several cameras, an error names the one to turn."""
    try:
        return list(_observed(args, images, is_one_of_several))
    except InputError as error:  # reads: "..., such as --facing left.LeftGoalLine=left, ..."
        if not is_one_of_several:
            raise
        raise InputError(str(error).replace("--facing ", f"--facing {args.camera}.")) from None


def _observed(args: RunArguments, images: list[Path], is_one_of_several: bool) -> Iterator[_Step]:
    """Yield the steps: boards first; photographs without a board may show the field. One of several cameras may see
    boards only.
    """
    rest = [str(path) for path in images]
    if args.board is not None:
        goal = ["--camera", args.camera, "-o", str(args.output / "board.json")]
        asked = [*rest, *arguments.board_words(args.board), *goal]
        try:
            found = _step(args, "detect board", asked, most=1)
            rest = [path for path in rest if path not in found.data["found"]]
            # The other photographs may show the field.
            yield found if args.target is None else replace(found, lines=found.lines[:1])
        except NothingShownError as error:  # reads: "..." below the command of this step
            if args.target is None:
                raise
            yield _Step(COMMANDS["detect board"].typed(asked), (str(error),), {}, 1)
    if args.target is not None:
        if not rest and is_one_of_several:
            return
        if not rest:
            raise InputError("every photograph shows the board, and none is left for the field: take one without it")
        said = [*arguments.repeated("--facing", args.facing), *arguments.repeated("--estimate", args.estimate)]
        said += ["--not-painted", args.not_painted] if args.not_painted else []
        goal = ["--camera", args.camera, "-o", str(args.output / "field.json")]
        still = [] if images_and_videos(args.images)[0] else ["--median"]  # for videos only
        asked = [*rest, *still, "--target", args.target, "--auto", *said, *goal]
        yield _step(args, "detect field", asked, most=1)


def _calibrated(
    args: RunArguments, cameras: Sequence[RunArguments], detected: Sequence[dict[str, Any]], observations: Sequence[str]
) -> _Step:
    priors = arguments.repeated("--prior", args.prior)
    goal = ["-o", str(args.output / "calibration.json"), "--report", str(args.output / "report.html")]
    seen = [(one, *images_and_videos(one.images)) for one in cameras]
    folders = [str(detect.folder_of_frames(video, one.output)) for one, _, videos in seen for video in videos]
    given = [name for one, images, _ in seen if images for name in one.images]
    shown = [name for name in (*given, *folders) if Path(name).is_dir() or Path(name).suffix.lower() in IMAGE_ENDINGS]
    medians = [data["median"]["picture"] for data in detected if "median" in data]
    images = arguments.repeated("--images", [*shown, *medians])
    asked = [*observations, "--lens", args.lens, *priors, *goal, *images]
    return _step(args, "calibrate", asked, titles=_SHOWN)


def _exported(args: RunArguments, cameras: Sequence[RunArguments], form: formats.ExportFormat) -> Iterator[_Step]:
    """Yield one export, or one for each camera if the format does not hold so many."""
    ending = (form.endings or ("",))[0]
    asked = [str(args.output / "calibration.json"), "--to", form.name]
    if form.holds(len(cameras)):
        yield _attempted(args, "export", [*asked, "-o", f"{args.output / form.name}{ending}"])
        return
    for one in cameras:
        goal = ["--station", one.camera, "-o", f"{one.output / form.name}{ending}"]
        yield _attempted(args, "export", [*asked, *goal])


# ---- for people -----------------------------------------------------------------------------------------------------


def _sections(
    args: RunArguments, cameras: Sequence[RunArguments], images: int, steps: Sequence[_Step], level: str
) -> Iterator[Section]:
    yield Section("read", [f"{plural(images, 'photograph')} in {first_of(args.images, _MOST_NAMES)}"])
    yield turned_section(video for one in cameras for video in images_and_videos(one.images)[1])
    for number, step in enumerate(steps, start=1):
        yield _BLANK
        yield Section(f"step {number}", [_short(step.command)])
        yield Section("", step.lines)
    yield _BLANK
    files = {str(step.data[name]) for step in steps for name in ("output", "report") if step.data.get(name)}
    made = sorted({str(Path(path).relative_to(args.output)) for path in files})
    yield Section("written", [f"{args.output}/: {', '.join(made)}"])
    if args.to and level == "no":
        yield Section("warning", ["a calibration that is not to be trusted was not exported"])


def _short(command: str) -> str:
    """Shorten a command to the first of its photographs, and leave out options that name the others."""
    words = shlex.split(command)
    places = [place for place, word in enumerate(words) if Path(word).suffix.lower() in IMAGE_ENDINGS]
    if len(places) <= _MOST_NAMES:
        return command
    first, *others = places
    gone = {*others, *(place - 1 for place in others if words[place - 1] == "--images")}
    after = [word for place, word in enumerate(words) if place > first and place not in gone]
    return " ".join(filter(None, (shlex.join(words[: first + 1]), "...", shlex.join(after))))
