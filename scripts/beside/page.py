"""docs/peers.md from the stored answers: the tables, and the text around them from peers.md.in."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from beside.environments import TITLES
from beside.lies import FAULTS, WRONG_SDS
from beside.sets import SOURCES

_Found = Mapping[str, Any]
_Rows = Sequence[Mapping[str, Any]]
_WORDS = Path(__file__).with_name("peers.md.in")
_MARK = re.compile(r"^\{\{(\w+)\}\}$", re.MULTILINE)


def _figure(value: float | None, digits: int = 3) -> str:
    """The value with so many digits; a dash if there is none. Values above 10 000 mean a lens outside its range."""
    if value is None or value != value:
        return "-"
    if value > 10_000:
        return "> 10000"
    text = f"{value:.{digits}g}"
    return f"{value:.0f}" if "e" in text else text


def _table(head: Sequence[str], lines: Sequence[Sequence[str]]) -> list[str]:
    if not lines:
        return ["Not in the stored run."]
    return [f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *lines)]


def _names(rows: _Rows, key: str, order: Sequence[str]) -> list[str]:
    there = {row[key] for row in rows}
    return [name for name in order if name in there]


def _title(peer: str, setting: str) -> str:
    return TITLES[peer] if setting == "default" else f"{TITLES[peer]}, {setting}"


# ---- boards ---------------------------------------------------------------------------------------------------------


def _by_set(
    rows: _Rows, cell: Callable[[Mapping[str, Any]], str], kept: Callable[[Mapping[str, Any]], bool]
) -> list[str]:
    """A line for each peer and setting, a column for each set."""
    some = [row for row in rows if kept(row)]
    sets = _names(some, "set", list(SOURCES))
    keys = list(dict.fromkeys((row["peer"], row["setting"]) for row in some))
    keys.sort(key=lambda key: list(TITLES).index(key[0]))
    cells = {(row["peer"], row["setting"], row["set"]): cell(row) for row in some}
    lines = [[_title(*key), *(cells.get((*key, name), "") for name in sets)] for key in keys]
    return _table(["", *sets], lines)


def truth_numbers(found: _Found) -> list[str]:
    """Difference of each number over its stated standard deviation."""
    return _by_set(found.get("truth", ()), lambda row: _figure(row.get("numbers")), lambda row: "numbers" in row)


def truth_projections(found: _Found) -> list[str]:
    """The same for projections, with the difference between the two halves."""

    def cell(row: Mapping[str, Any]) -> str:
        return f"{_figure(row['projections'])} ({_figure(row['apart_px'], 2)} px)"

    return _by_set(found.get("truth", ()), cell, lambda row: "projections" in row)


def over_predicted(found: _Found) -> list[str]:
    """Held-out error over the predicted error, for the default of each peer that states a noise."""

    def kept(row: Mapping[str, Any]) -> bool:
        return "over_predicted" in row and row["setting"] in ("default", "OPENCV", "fisheye", "as drawn")

    return _by_set(found.get("prediction", ()), lambda row: _figure(row["over_predicted"]), kept)


def prediction(found: _Found) -> list[str]:
    """Held-out error with the default, and with the setting that predicts best."""
    rows = [row for row in found.get("prediction", ()) if "rms_px" in row]
    sets = _names(rows, "set", list(SOURCES))
    peers = _names(rows, "peer", list(TITLES))
    lines = []
    for name in sets:
        line = [name]
        for peer in peers:
            own = {row["setting"]: row["rms_px"] for row in rows if row["set"] == name and row["peer"] == peer}
            best = min(own, key=own.__getitem__) if own else ""
            first = _figure(own.get("default"))
            line.append(first if best in ("", "default") else f"{first}; {best}: {_figure(own[best])}")
        lines.append(line)
    return _table(["held-out rms, px", *(TITLES[peer] for peer in peers)], lines)


# ---- fields ---------------------------------------------------------------------------------------------------------


def ssl(found: _Found) -> list[str]:
    """Mean error over the field in mm."""
    rows = found.get("ssl", ())
    methods = list(dict.fromkeys(row["method"] for row in rows))
    cells = {(row["scene"], row["noise"], row["method"]): row for row in rows}
    lines = []
    for scene, noise in dict.fromkeys((row["scene"], row["noise"]) for row in rows):
        own = [cells.get((scene, noise, method), {}) for method in methods]
        both = [f"{_figure(one.get('floor_mm'))} / {_figure(one.get('robot_mm'))}" for one in own]
        lines.append([scene, noise, *both])
    return _table(["scene", "noise", *methods], lines)


def soccernet(found: _Found) -> list[str]:
    """SoccerNet's figures."""
    names = ("completeness", "jac5", "jac20", "final")
    lines = [
        [row["method"], str(row["frames"]), *(f"{row[name]:.3f}" for name in names)]
        for row in found.get("soccernet", ())
    ]
    return _table(["", "frames", "completeness", "JaC@5", "JaC@20", "completeness x JaC@5"], lines)


# ---- speed ----------------------------------------------------------------------------------------------------------


def corners(found: _Found) -> list[str]:
    """Seconds of a solve and of a whole process, and MiB, for the smallest and largest number of frames."""
    rows = found.get("corners", ())
    each = sorted({row["frames"] for row in rows})
    ends = list(dict.fromkeys(each[:1] + each[-1:]))
    cells = {(row["peer"], row["setting"], row["frames"]): row for row in rows}
    what = {"solve_s": "solve, s", "whole_s": "process, s", "peak_mib": "MiB"}
    lines = []
    for peer, setting in dict.fromkeys((row["peer"], row["setting"]) for row in rows):
        own = [_figure(cells.get((peer, setting, count), {}).get(name)) for name in what for count in ends]
        lines.append([f"{TITLES[peer]}, {setting}", *own])
    return _table(["", *(f"{title}: {count} frames" for title in what.values() for count in ends)], lines)


def photographs(found: _Found) -> list[str]:
    """Elapsed and processor seconds from photographs to a result."""
    rows = found.get("photographs", ())
    methods = list(dict.fromkeys(row["method"] for row in rows))
    cells = {
        (row["set"], row["method"]): f"{_figure(row.get('whole_s'))} ({_figure(row.get('processor_s'))})"
        for row in rows
    }
    sets = list(dict.fromkeys(row["set"] for row in rows))
    return _table(["photographs", *methods], [[name, *(cells.get((name, m), "") for m in methods)] for name in sets])


# ---- lies -----------------------------------------------------------------------------------------------------------


def lies(found: _Found) -> list[str]:
    """For each fault: what is reported, and whether the answer is right."""
    rows = found.get("lies", ())
    peers = _names(rows, "peer", list(TITLES))
    cells = {(row["fault"], row["peer"]): _lie(row) for row in rows}
    lines = [[f"{name}: {FAULTS[name].what}", *(cells.get((name, p), "") for p in peers)] for name in FAULTS]
    return _table(["fault", *(TITLES[peer] for peer in peers)], lines)


def _lie(row: Mapping[str, Any]) -> str:
    if row["notices"].startswith("refuses"):
        return str(row["notices"])
    if not row["wrong"]:
        return f"{row['notices']}; right"
    if row["scale"] != 1.0:
        return f"{row['notices']}; lengths {row['scale']:g} times"
    if row.get("sds", 0.0) > WRONG_SDS:
        return f"{row['notices']}; wrong by {_figure(row['sds'], 2)} sd"
    if "stated_px" in row:
        return f"{row['notices']}; wrong by {_figure(row['off_px'], 2)} px, states {_figure(row['stated_px'], 2)}"
    return f"{row['notices']}; wrong, states nothing"


def counts(found: _Found) -> list[str]:
    """Of the ten faults: number of those named, noticed, and wrong without a message."""
    rows = [row for row in found.get("lies", ()) if row["fault"] != "sound"]
    lines = []
    for peer in _names(rows, "peer", list(TITLES)):
        own = [row for row in rows if row["peer"] == peer]
        named = sum("named" in row["notices"] for row in own)
        noticed = sum(row["notices"] != "no" for row in own)
        silent = sum(row["notices"] == "no" and row["wrong"] for row in own)
        lines.append([TITLES[peer], str(named), str(noticed), str(silent)])
    return _table(["of ten", "named", "noticed in any way", "wrong without a message"], lines)


# ---- the page -------------------------------------------------------------------------------------------------------


def versions(found: _Found) -> list[str]:
    """Versions of the peers."""
    there = found.get("environment", {})
    lines = [[TITLES[name], version] for name, version in there.get("versions", {}).items()]
    lines += [[TITLES[name], f"not installed: {why}"] for name, why in there.get("missing", {}).items()]
    return _table(["", "version"], lines)


def sets(found: _Found) -> list[str]:
    """Sources of the sets."""
    return _table(
        ["set", "what", "where", "licence"],
        [[name, one.what, one.where, one.licence] for name, one in SOURCES.items()],
    )


TABLES: Mapping[str, Sequence[Callable[[_Found], list[str]]]] = {
    "truth": (truth_numbers, truth_projections),
    "prediction": (prediction, over_predicted),
    "lies": (lies, counts),
    "fields": (ssl, soccernet),
    "speed": (corners, photographs),
}
_EVERY = {table.__name__: table for table in (*sum(map(tuple, TABLES.values()), ()), versions, sets)}


def made(found: _Found) -> str:
    """The page."""
    return _MARK.sub(lambda mark: "\n".join(_EVERY[mark[1]](found)), _WORDS.read_text(encoding="utf-8"))
