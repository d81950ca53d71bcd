"""A robocup-ssl.xml as ssl-vision writes it, for tests and for scripts/fuzz.py."""

from __future__ import annotations


def var(name: str, kind: str, inside: str) -> str:
    return f'<Var name="{name}" type="{kind}">{inside}</Var>\n'


def settings(cameras: int = 2, opencv: str = "true") -> str:
    """A robocup-ssl.xml."""
    names = ["focal length", "principal point x", "principal point y", "distortion", *(f"q{n}" for n in range(4))]
    size = {"Field Length": 9000, "Field Width": 6000, "Goal Width": 1000, "Penalty Area Depth": 1000}
    size |= {"Penalty Area Width": 2000, "Center Circle Radius": 500, "Line Thickness": 10}
    line = "".join(
        var(name, "double", value)
        for name, value in zip(
            ("P1.x", "P1.y", "P2.x", "P2.y", "Line thickness"), ("-4500", "3000", "4500", "3000", "10"), strict=True
        )
    )
    lines = var("TopTouchLine", "list", var("Name", "string", "TopTouchLine") + line)
    field = "".join(var(name, "double", f"{value}.000000") for name, value in size.items())
    text = var("Global", "list", var("Field Configuration", "list", field + var("Field Lines", "list", lines)))
    for number in range(cameras):
        values = [500.0, 320.0, 240.0, 0.1, 0.7, 0.7, 0.0, 0.1, 0.0, 0.0, 4000.0]
        own = "".join(
            f'<Var name="{name}" type="double" minval="" maxval="">\n  {str(value).replace(".", ",")}\n</Var>\n'
            for name, value in zip([*names, "tx", "ty", "tz"], values, strict=True)
        )
        inner = var("Intrinsic Parameters", "list", var("focal_length_x", "double", "1.0"))
        own = inner + var("use openCV camera model", "bool", opencv) + own
        other = var("camera index", "int", str(number)) + var("Image width", "int", "1280")
        other += var("Image height", "int", "960")
        lists = var("Camera Parameters", "list", own) + var("Calibration Parameters", "list", other)
        text += var(f"Thread {number}", "list", var("Camera Calibrator", "list", lists))
    return f'<?xml version="1.0"?>\n<!-- by hand &amp; kept -->\n<VarXML>\n{text}</VarXML>\n'
