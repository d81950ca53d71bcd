"""One session: the state and its history, the results for it, and what the page shows of both."""

from __future__ import annotations

import tempfile
import threading
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from msgspec import Struct

from ceres_cal import detect, diagnostics, formats, moves, report, scene
from ceres_cal.base import Frozen, InputError, answer_or_reason, frame_of, make_folder, mm, replace
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.cli.files import read_target
from ceres_cal.cli.open_steps import make
from ceres_cal.cli.page.state import (
    Change,
    CommandResults,
    Drag,
    PageContext,
    State,
    load_state,
    save_state,
    target_words,
)
from ceres_cal.detect.photographs.by_hand import FEWEST
from ceres_cal.observations import Observations, combine
from ceres_cal.problem.parameters import Options

KEPT = "page.json"
_MOST_UNDONE = 200
_BY_HAND = Options(
    lens="radial", powers=(3,), noise_scale="stated", free_principal_point=False, free_aspect=False, usual_camera=False
)


class _Moment(Frozen, eq=True):
    """A state with its results and their commands. `auto`: found without a start. `base`: camera found before."""

    state: State
    base: scene.Camera | None = None
    found: PageResult | None = None
    made: CommandResults | None = None
    auto: bool = False


class Session:
    """State and results that the page works on. One thread at a time changes it and holds `lock` meanwhile."""

    def __init__(self, sitting: PageContext, state: State) -> None:
        self.sitting: PageContext = sitting
        self.lock: Any = threading.RLock()
        self.revision: int = 0
        self.message: str = ""
        self.written: tuple[str, ...] = ()
        self.said: tuple[str, ...] = ()
        self._strokes: dict[str, Any] = {}
        self._by_hand: dict[str, Any] | None = None
        self._past: list[_Moment] = []
        self._future: list[_Moment] = []
        self._now = _Moment(state)
        self._camera: scene.Camera | None = None
        self._targets: dict[str, scene.Target] = {}
        self._start = None if sitting.start is None else Calibration.load(sitting.start)
        self._other = None if sitting.other is None else Calibration.load(sitting.other)
        self._against: dict[str, float] = {}
        self._settle()

    # ---- what there is ----

    @property
    def state(self) -> State:
        return self._now.state

    def target(self, state: State) -> scene.Target | None:
        """Return the field that is searched, with the changed dimensions."""
        if not state.target:
            if self._start is None:
                return None
            return next((one for one in self._start.targets.values() if detect.is_painted(one)), None)
        drawn = self._target(state.target)
        return self._target(target_words(state, drawn)) if state.lengths else drawn

    def _target(self, text: str) -> scene.Target:
        if text not in self._targets:
            if not (text == self.sitting.target or text in scene.targets_by_name() or text.startswith("{")):
                raise InputError(f"the field {text!r} was not named on the command line and is not in the list")
            self._targets[text] = read_target(text, "field")
        return self._targets[text]

    def _base(self, target: scene.Target) -> scene.Camera:
        """Return the camera that the clicks correct."""
        if self._now.base is not None:
            return self._now.base
        if self._start is not None:
            return self._start.station()
        return detect.by_hand.guess(target, self.sitting.sizes[0], self.state.facing.rpartition("=")[2])

    # ---- changes ----

    def change(self, change: Change) -> None:
        """Replace the state; InputError if another window changed it before, or it names what does not exist."""
        if change.revision != self.revision:
            raise InputError("another window changed it meanwhile: look at what is there now, and do it again")
        written = msgspec.structs.replace(change.state, exports=self.state.exports)
        self._become(change.state, keep=written == self.state)  # results do not depend on the files to be written

    def drag(self, drag: Drag) -> None:
        """Move a point or place with the pointer; earlier results are dropped, since they belong to other clicks."""
        target = self.target(self.state)
        if target is None:
            raise InputError("choose the field first, such as ssl-b")
        state = drag.of(self.state, target)
        base = self._base(target)
        self._camera = detect.by_hand.solved(_shown(state, target), self._camera or base, base, quickly=True)
        if drag.last:
            self._become(state, camera=self._camera)

    def step(self, *, back: bool) -> None:
        """Undo, or redo."""
        these, those = (self._past, self._future) if back else (self._future, self._past)
        if these:
            those.append(self._now)
            self._now = these.pop()
            self._camera = None
            self._settle()

    def _become(self, state: State, camera: scene.Camera | None = None, *, keep: bool = False) -> None:
        target = self.target(state)
        if target is not None:
            _require_names(state, target)
        self._remember(replace(self._now, state=state) if keep else _Moment(state, self._now.base))
        self._camera = camera
        self._settle()

    def _remember(self, moment: _Moment) -> None:
        self._past = [*self._past[1 - _MOST_UNDONE :], self._now]
        self._future.clear()
        self._now = moment

    def _settle(self) -> None:
        """Fit the camera of the present state, and find clicks that contradict it; save the state in the folder."""
        self.revision += 1
        self.message, self._against = "", {}
        target = self.target(self.state)
        if target is not None and self._now.found is None:
            base, shown = self._base(target), _shown(self.state, target)
            settled = detect.by_hand.settled(shown, self._camera or base, base)
            self._camera, self._against, self.message = settled
        elif target is not None:
            self._camera = self._now.base
        self._by_hand = None
        # If saving fails, the window, which still has everything, says so.
        _, unkept = answer_or_reason(lambda: save_state(make_folder(self.sitting.folder) / KEPT, self.state))
        self.message = self.message or unkept

    # ---- work that takes seconds ----

    def find(self, *, auto: bool) -> None:
        """Measure the paint from where the model is, or find the field without a start, and calibrate."""
        moment = self._now
        target = self.target(moment.state)
        with tempfile.TemporaryDirectory(prefix="ceres-cal-") as folder:
            made = make(self.sitting, moment.state, target, Path(folder), auto=auto)
            observations = combine([Observations.load(Path(folder) / name) for name in made.observed])
            calibration = Calibration.load(made.calibration)
            found = PageResult(calibration, observations, report.known_of(report.quality_of(calibration, observations)))
        with self.lock:
            if self._now is not moment:
                raise InputError("it was changed meanwhile: find the lines again")
            base = calibration.station() if target is not None else None
            self._remember(replace(moment, base=base, found=found, made=made, auto=auto))
            self._settle()

    def done(self) -> None:
        """Write the results by the commands, and list these as they would be typed."""
        moment = self._now
        if moment.made is None:
            raise InputError("find the lines first: there is no calibration to be written yet")
        target, folder = self.target(moment.state), make_folder(self.sitting.folder)
        made = make(self.sitting, moment.state, target, folder, auto=moment.auto, known=moment.made)
        with self.lock:
            self.written, self.message = made.typed, ""
            self.revision += 1

    def weigh(self) -> bool:
        """Do background work that takes a second: advice if the lines were found; before that, what the clicks alone
        determine with a lens of one coefficient. Return whether there is anything new to show.
        """
        moment, revision, target = self._now, self.revision, self.target(self.state)
        if moment.found is not None:
            known = moment.found.known
            if "advice" in known or not known["maps"]:
                return False
            known["advice"] = report.advice_of(moment.found.calibration)
            return self._now is moment
        if target is None or len(moment.state.points) < FEWEST:
            return False
        seen = _shown(moment.state, target).observed(self.sitting.sizes[0])
        told = report.known_of(report.quality_of(calibrate(seen, _BY_HAND), seen))
        with self.lock:
            current = self.revision == revision
            self._by_hand = told if current else self._by_hand
        return current

    def check(self, photograph: int) -> None:
        """Check by one photograph whether the camera of an old calibration has moved, and by how many pixels it is off
        where; and how far another calibration differs from it.
        """
        path, old = self.sitting.photographs[photograph], self._start
        if old is None:
            raise InputError("there is no old calibration to be checked: open one with the photograph")
        answers, seen = detect.check_photographs(old, [path])
        said = [f"{name}: {one.words}" for name, one in answers.items()]
        strokes: dict[str, Any] = {}
        if seen.observations is not None:
            table = diagnostics.diagnose(old, seen.observations, new_data=True).table
            off = np.abs(table.distance_px[np.isfinite(table.distance_px)])
            said.append(f"its lines are {np.median(off):.2f} px off the paint (median), {off.max():.2f} px at most")
            strokes = report.strokes_of(table)
        if self._other is not None and self.sitting.other is not None:
            apart, name = self._model_of(old, path).apart_px(self._model_of(self._other, path)), self.sitting.other
            said.append(f"{name} draws them {apart[0]:.2f} px away from these (median), {apart[1]:.2f} px at most")
            for station, one in moves.compare(old, self._other).items():
                if one.change is not None:
                    floor = one.change.maps[0]
                    said.append(f"{station}: places on the floor differ by {mm(floor.rms_mm)} (rms)")
        with self.lock:
            self.said, self._strokes = tuple(said), strokes
            self.revision += 1

    # ---- what is shown ----

    def model(self, drag: Drag | None = None) -> dict[str, Any]:
        """Return the model as it is drawn: lines and points px, and where it places what was clicked."""
        target = self.target(self.state)
        if target is None or self._camera is None:
            return {"lines": {}, "points": {}, "feet": []}
        camera = self._camera
        state = self.state if drag is None or drag.last else drag.of(self.state, target)
        shown = _shown(state, target)
        points = camera.project(target.point_array)
        return {
            "lines": {
                name: np.round(line, 1).tolist()
                for name, line in detect.by_hand.curves_in_image(target, camera).items()
            },
            "points": dict(zip(target.point_names, np.round(points, 1).tolist(), strict=True)),
            "feet": np.round(detect.by_hand.feet(shown, camera), 1).tolist(),
        }

    def everything(self) -> dict[str, Any]:
        """Return all that a window needs to show this session."""
        target, found = self.target(self.state), self._now.found
        boards = () if self._now.made is None else self._now.made.boards
        words = "" if target is None else target_words(self.state, target)
        return {
            "is": "state",
            "revision": self.revision,
            "state": self.state,
            "photographs": [
                {"name": path.name, "frame": frame_of(path), "size": size, "board": path in boards}
                for path, size in zip(self.sitting.photographs, self.sitting.sizes, strict=True)
            ],
            "targets": list(scene.targets_by_name()),
            "formats": list(formats.EXPORT_FORMATS),
            "scale": {"borders": report.MM.borders, "colors": report.COLORS},
            "target": None if target is None else _about(target, words),
            "goal": "" if target is None else detect.distinguishing_feature(target, tuple(target.curves)),
            "model": self.model(),
            "against": self._against,
            "known": self._by_hand if found is None else found.known,
            "found": found is not None,
            "placed": self._placed(),
            "said": self.said,
            "checked": self._strokes,
            "looked": self._looked(),
            "message": self.message,
            "written": self.written,
            "folder": str(self.sitting.folder),
            "undo": len(self._past),
            "redo": len(self._future),
        }

    def _looked(self) -> dict[str, Any]:
        """Return the named calibrations, the second one with its lines."""
        named = {"start": self.sitting.start, "other": self.sitting.other}
        alike = self.sitting.other is not None and self.sitting.other.name == getattr(self.sitting.start, "name", "")
        drawn: dict[str, Any] = {
            what: {"name": str(path) if alike else path.name} for what, path in named.items() if path is not None
        }
        if self._other is not None:
            drawn["other"]["lines"] = _lines(self._model_of(self._other, self.sitting.photographs[0]))
        return drawn

    def _model_of(self, calibration: Calibration, photograph: Path) -> report.Model:
        station = next(iter(calibration.stations))
        return report.model_of(calibration, report.frame_by_name(calibration, station, frame_of(photograph)))

    def _placed(self) -> dict[str, Any]:
        """Return the boards that were found, by frame, as the calibration places them."""
        found = self._now.found
        if found is None:
            return {}
        frames = (
            replace(one, shown=tuple(s for s in one.shown if s[1])) for one in report.frames_of(found.observations)
        )
        return {one.name: _lines(report.model_of(found.calibration, one)) for one in frames if one.shown}


class PageResult(Struct, frozen=True, eq=False):
    """Result of "find the lines"; `known`: its description for the page."""

    calibration: Calibration
    observations: Observations
    known: dict[str, Any]


def _lines(model: report.Model) -> list[Any]:
    """(S, 2) px of each line."""
    return [np.round(line[0][::4], 1).tolist() for line in model.lines]


def _shown(state: State, target: scene.Target) -> detect.PointHints:
    points = {name: (one.x, one.y, one.sigma) for name, one in state.points.items()}
    return detect.PointHints.of(target, points, [(one.curve, one.x, one.y, one.sigma) for one in state.places])


def _require_names(state: State, target: scene.Target) -> None:
    """Raise InputError where the state names what the target does not have."""
    unknown = [name for name in state.points if name not in target.point_index]
    named = (*state.not_painted, *(one.curve for one in state.places))
    unknown += [name for name in named if name not in target.curves]
    unknown += [name for name in (*state.lengths, *state.solved) if name not in target.dimensions]
    if unknown:
        raise InputError(f"{unknown[0]!r} is not one of the target's: `ceres-cal targets` lists the names")


def _about(target: scene.Target, words: str) -> dict[str, Any]:
    """Return what a window shows of a target."""
    return {
        "words": words,
        "points": list(target.point_names),
        "curves": list(target.painted),
        "dimensions": dict(target.dimensions),
    }


def opened(sitting: PageContext, first: State) -> Session:
    """Return the session of a folder: an earlier one is continued, unless the command line names another field."""
    kept = sitting.folder / KEPT
    state = load_state(kept) if kept.exists() else first
    if first.target and first.target != state.target:
        state = first
    return Session(sitting, state)
