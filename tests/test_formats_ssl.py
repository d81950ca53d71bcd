"""ssl-vision's and vision-processor's formats: decoded by google.protobuf with the published field numbers, used with
their published equations, and sent over the loopback interface.
"""

import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from foreign_cases import LENSES, SSL_LENS, over_field, places, same_camera, two_cameras, with_lens
from google.protobuf import descriptor_pb2, descriptor_pool, json_format, message_factory
from ssl_settings_file import settings

from ceres_cal import Calibration, InputError
from ceres_cal.base.arrays import Array
from ceres_cal.cli import main
from ceres_cal.formats import Group, export, import_calibration, publish, received_geometry, ssl_packet
from ceres_cal.formats.ssl_fields import field_of, target_of
from ceres_cal.formats.ssl_messages import from_bytes, to_bytes
from ceres_cal.scene.camera import in_image
from ceres_cal.scene.lens import KannalaBrandt
from ceres_cal.scene.targets import Arc, Segment, custom, ssl_field

# name, number, type as published; F is a required float, f an optional one
CALIB = (
    "camera_id:1:U focal_length:2:F principal_point_x:3:F principal_point_y:4:F distortion:5:F q0:6:F q1:7:F q2:8:F "
    "q3:9:F tx:10:F ty:11:F tz:12:F derived_camera_world_tx:13:f derived_camera_world_ty:14:f "
    "derived_camera_world_tz:15:f pixel_image_width:16:u pixel_image_height:17:u"
)
FIELD = (
    "field_length:1:I field_width:2:I goal_width:3:I goal_depth:4:I boundary_width:5:I penalty_area_depth:8:i "
    "penalty_area_width:9:i center_circle_radius:10:i line_thickness:11:i goal_center_to_penalty_mark:12:i "
    "goal_height:13:i ball_radius:14:f max_robot_radius:15:f"
)
_KINDS = {"F": 2, "I": 5, "U": 13}


@cache
def pool() -> Any:
    """All message classes, from the published numbers."""
    file = descriptor_pb2.FileDescriptorProto(name="published.proto", syntax="proto2")
    for title, fields in (("Calib", CALIB), ("Field", FIELD)):
        message = file.message_type.add(name=title)
        for field in fields.split():
            label, number, kind = field.split(":")
            message.field.add(
                name=label, number=int(number), type=_KINDS[kind.upper()], label=2 if kind.isupper() else 1
            )
    data = file.message_type.add(name="Data")
    data.field.add(name="field", number=1, type=11, type_name=".Field", label=2)
    data.field.add(name="calib", number=2, type=11, type_name=".Calib", label=3)
    wrapper = file.message_type.add(name="Wrapper")
    wrapper.field.add(name="geometry", number=2, type=11, type_name=".Data", label=1)
    wrapper.field.add(name="source", number=3, type=5, label=1)
    every = descriptor_pool.DescriptorPool()
    every.Add(file)
    return every


def published(name: str) -> Any:
    """One of the message classes."""
    return message_factory.GetMessageClass(pool().FindMessageTypeByName(name))


def rotation(calib: Any) -> Array:
    """Eigen's rotation matrix of a quaternion x, y, z, w."""
    x, y, z, w = calib.q0, calib.q1, calib.q2, calib.q3
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def field_to_image(calib: Any, places_mm: Array) -> Array:
    """CameraModel::field2image of vision-processor: ten iterations for the radius."""
    p = places_mm @ rotation(calib).T + (calib.tx, calib.ty, calib.tz)
    u = p[:, :2] / p[:, 2:]
    ru = np.linalg.norm(u, axis=1)
    rd = ru.copy()
    for _ in range(10):
        rd -= (rd * (1 + calib.distortion * rd**2) - ru) / (1 + 3 * calib.distortion * rd**2)
    return np.asarray(calib.focal_length * u * (rd / ru)[:, None] + (calib.principal_point_x, calib.principal_point_y))


def image_to_field(calib: Any, pixels: Array, height_mm: float) -> Array:
    """image2field of both programs."""
    u = (pixels - (calib.principal_point_x, calib.principal_point_y)) / calib.focal_length
    u = u * (1 + calib.distortion * np.sum(u**2, axis=1))[:, None]
    turn = rotation(calib)
    rays = np.column_stack([u, np.ones(len(u))]) @ turn
    camera = -turn.T @ (calib.tx, calib.ty, calib.tz)
    return np.asarray((camera + rays * ((height_mm - camera[2]) / rays[:, 2])[:, None])[:, :2])


def shown_on_field(calibration: Calibration, height_m: float) -> tuple[Array, Array]:
    """Pixels on the field and their places, m."""
    camera = calibration.station()
    true = np.random.default_rng(3).uniform((-4.5, -3.0), (4.5, 3.0), (3000, 2))
    pixels = camera.project(np.column_stack([true, np.full(len(true), height_m)]))
    seen = in_image(pixels, camera.image_size)
    return pixels[seen], true[seen]


@pytest.mark.parametrize("lens", LENSES)
def test_our_packet_calibrates_vision_processor(lens: str, tmp_path: Path) -> None:
    """It searches any packet for its own camera id, and uses that entry."""
    calibration = over_field(with_lens(lens))
    packet, exported = ssl_packet(calibration, camera_id="3")
    wrapper = published("Wrapper").FromString(packet)
    (calib,) = [one for one in wrapper.geometry.calib if one.camera_id == 3]
    assert wrapper.source == 1 and wrapper.geometry.field.field_length == 9000
    camera = calibration.station()
    derived = [calib.derived_camera_world_tx, calib.derived_camera_world_ty, calib.derived_camera_world_tz]
    assert np.abs(1e-3 * np.array(derived) - camera.position).max() < 1e-6
    assert (calib.pixel_image_width, calib.pixel_image_height) == camera.image_size
    (loss,) = exported.losses
    for height_m in (0.0, 0.15):
        pixels, true = shown_on_field(calibration, height_m)
        off = 1e3 * np.linalg.norm(1e-3 * image_to_field(calib, pixels, 1e3 * height_m) - true, axis=1)
        rms = np.sqrt(np.mean(off**2))
        stated = loss.field_mm[height_m]
        assert rms == pytest.approx(stated[0], rel=0.1, abs=3e-4) and off.max() <= 1.1 * stated[1] + 1e-3
    if lens == "radial-3":
        points, pixels = places(camera)
        assert np.abs(field_to_image(calib, 1e3 * points) - pixels).max() < 1e-3  # float32; measured 2e-4
        assert loss.field_mm[0.15][1] < 1e-3 and exported.warnings == ()


def test_what_loses_less_is_named(tmp_path: Path) -> None:
    """For a lens that one coefficient cannot describe, OpenCV's model is recommended."""
    exported = export(over_field(with_lens(KannalaBrandt((-0.03, 0.002, 0.0, 0.0)))), "ssl-vision", tmp_path / "a.pb")
    worst = max(worst for _, worst in exported.losses[0].field_mm.values())
    (said,) = [text for text in exported.warnings if "one coefficient cannot describe this lens" in text]
    assert worst > 10.0 and f"{worst:.3g} mm)" in said and "--to opencv (0 mm at most)" in said
    oblong = over_field(with_lens(SSL_LENS, aspect=1.01))
    (said,) = export(oblong, "ssl-vision", tmp_path / "b.pb").warnings
    assert "one focal length cannot describe fy / fx = 1.0100" in said and "--fix aspect=1" in said


def test_a_negative_distortion_is_said_out_loud(tmp_path: Path) -> None:
    bent = with_lens(SSL_LENS.with_values([-1e-7]))
    (warning,) = export(over_field(bent), "ssl-vision", tmp_path / "a.pb").warnings
    assert "station 'overhead': its distortion is negative: ssl-vision uses it to locate, but not to draw" in warning
    assert any("negative" in text for text in import_calibration(tmp_path / "a.pb").warnings)


def test_geometry_yml_parses_as_vision_processor_parses_it(tmp_path: Path) -> None:
    """With json_format.ParseDict, into the published message."""
    export(two_cameras(SSL_LENS), "vision-processor", tmp_path / "geometry.yml")
    given = yaml.safe_load((tmp_path / "geometry.yml").read_text())
    assert {line["type"] for line in given["field"]["field_lines"]} <= {*ssl_field("B").curves}
    message = json_format.ParseDict(given, published("Data")(), ignore_unknown_fields=True)  # the lines, see above
    assert message.IsInitialized() and [calib.camera_id for calib in message.calib] == [0, 1]
    export(two_cameras(SSL_LENS), "ssl-vision", tmp_path / "a.pb")
    assert list(published("Data").FromString((tmp_path / "a.pb").read_bytes()).calib) == list(message.calib)


@pytest.mark.parametrize("to, name", [("ssl-vision", "a.pb"), ("vision-processor", "a.yml")])
def test_a_file_that_is_there_keeps_its_field_and_other_cameras(to: str, name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    both = two_cameras(SSL_LENS)
    export(both, to, path)
    before = import_calibration(path)
    moved = over_field(with_lens("radial-3", number=1), "camera1")
    text = path.read_bytes()
    if name.endswith(".yml"):
        path.write_bytes(b"# ours\nvision_port: 10006\n" + text.replace(b"goal_depth: 180", b"goal_depth: 178"))
    export(moved, to, path)
    after = import_calibration(path)
    assert list(after.stations) == ["camera0", "camera1"]
    assert same_camera(after.station("camera0"), before.station("camera0"))
    assert same_camera(after.station("camera1"), moved.station(), 1e-6)
    if name.endswith(".yml"):
        written = path.read_text()
        assert written.startswith("# ours\nvision_port: 10006\n") and "goal_depth: 178" in written


def test_saved_calibrations_of_tournaments(real_data: Path, tmp_path: Path) -> None:
    files = sorted((real_data / "ssl_geometry_saved").glob("*.yml"))
    assert len(files) == 3
    for file in files:
        given = yaml.safe_load(file.read_text())
        calibration = import_calibration(file)
        for entry in given["calib"]:
            position = 1e3 * calibration.station(f"camera{entry['camera_id']}").position
            for axis, place in zip("xyz", position, strict=True):
                stored = entry.get(f"derived_camera_world_t{axis}", place)
                assert abs(stored - place) < 0.01  # mm; measured 0.0016
        copy, fresh = tmp_path / file.name, tmp_path / f"fresh-{file.name}"
        shutil.copy(file, copy)
        for path in (copy, fresh):
            export(calibration, "vision-processor", path)
            assert same_calib(given["calib"], yaml.safe_load(path.read_text())["calib"], exact=path == copy)
        assert yaml.safe_load(copy.read_text())["field"] == given["field"]
        again = import_calibration(copy)
        names = calibration.stations
        assert all(same_camera(again.station(n), calibration.station(n)) for n in names)


def same_calib(given: list[dict[str, Any]], written: list[dict[str, Any]], *, exact: bool) -> bool:
    """Every number that was given, to the last digit, or for a new file to float32 with either sign
    of the quaternion.
    """
    for before, after in zip(given, written, strict=True):
        turned = np.sign(sum(before[f"q{n}"] * after[f"q{n}"] for n in range(4)))
        for name, value in before.items():
            new = after[name] * (turned if name.startswith("q") else 1.0)
            close = abs(new - value) <= (2e-3 if name.startswith("derived") else 1e-6 * max(1.0, abs(value)))
            if not (value == after[name] if exact else close):
                return False
    return True


# ---- fields ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("division", ["A", "B"])
def test_a_field_goes_out_and_comes_back(division: str) -> None:
    field = ssl_field(division)
    message = field_of(field)
    assert len(message["field_lines"]) == 12 and len(message["field_arcs"]) == 1
    assert target_of(message) == field
    assert target_of({**message, "field_lines": [], "field_arcs": []}) == field
    longer = target_of({**message, "field_length": message["field_length"] - 10, "field_lines": [], "field_arcs": []})
    assert longer.points["TopRightCorner"][0] == pytest.approx(field.points["TopRightCorner"][0] - 0.005)
    aside = [dict(line) for line in message["field_lines"]]
    aside[0]["p1"] = {"x": -4500.0, "y": 3017.0}
    measured = target_of({**message, "field_lines": aside})
    line = measured.curves["TopTouchLine"]
    assert measured.kind == "custom" and isinstance(line, Segment) and line.start[1] == pytest.approx(3.017)
    assert target_of(field_of(measured)).curves == measured.curves


def test_what_is_no_field_is_refused() -> None:
    with pytest.raises(InputError, match="no lines: it is not a field"):
        field_of(custom({"pole": (0.0, 0.0, 1.0)}))
    with pytest.raises(InputError, match="the field has no field_width in mm"):
        target_of({"field_length": 9000})
    court = custom({}, {"edge": Segment((0, 0, 0), (4, 0, 0), 0.05), "side": Segment((0, 0, 0), (0, 3, 0), 0.05)})
    assert field_of(court)["field_length"] == 8000  # as far as it reaches to either side
    corner = Arc((-4.0, -3.0, 0.0), 1.0, 0.0, 0.5 * np.pi, 0.05)  # its circle would reach 2 m farther
    assert field_of(custom({}, {**court.curves, "corner": corner}))["field_width"] == 6000


# ---- ssl-vision's settings ------------------------------------------------------------------------------------------


def test_settings_are_edited_in_place(tmp_path: Path) -> None:
    path = tmp_path / "robocup-ssl.xml"
    path.write_text(settings())
    with pytest.raises(InputError, match=r"edited in place: name its robocup-ssl\.xml"):
        export(over_field(with_lens("radial-3")), "ssl-vision-xml", tmp_path / "new.xml")
    exported = export(over_field(with_lens("radial-3"), "camera1"), "ssl-vision-xml", path)
    assert any("must be closed" in text for text in exported.warnings)
    before, after = settings().splitlines(), path.read_text()
    back = import_calibration(path)
    assert back.targets["field"] == ssl_field("B")
    assert same_camera(back.station("camera1"), with_lens("radial-3"), 2e-6)
    assert back.station("camera0").phi == 500.0  # with a comma for a point
    assert sum("OpenCV mode is on" in text for text in back.warnings) == 1  # of the other one
    untouched = [line for line in before if line.strip() and line not in after]
    assert len(untouched) <= 12, untouched  # eleven numbers and the mode
    assert re.search(r'name="use openCV camera model" type="bool">false', after)
    export(over_field(back.station("camera1"), "camera1"), "ssl-vision-xml", path)
    assert path.read_text() == after


def test_what_ssl_vision_would_clamp_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "robocup-ssl.xml"
    path.write_text(settings())
    high = with_lens("radial-3").at(
        with_lens("radial-3").cam_from_world.__class__.looking((0, 0, 7.0), np.diag([1, -1, -1]))
    )
    with pytest.raises(InputError, match="tz 7000 mm is not between 0 and 6500, the range of ssl-vision"):
        export(over_field(high, "camera0"), "ssl-vision-xml", path)
    with pytest.raises(InputError, match="it has no camera 7, only 0, 1"):
        export(over_field(with_lens("radial-3"), "camera7"), "ssl-vision-xml", path)
    assert path.read_text() == settings()


# ---- over the network -----------------------------------------------------------------------------------------------


@pytest.fixture
def loopback() -> Group:
    """A multicast group with its own port, since members of a group also receive packets of other tests."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("", 0))
        return Group("224.5.23.9", free.getsockname()[1], "127.0.0.1")


def in_background(packet: bytes, group: Group) -> threading.Thread:
    sender = threading.Thread(target=publish, args=(packet, group, 20, 0.1), daemon=True)
    sender.start()
    return sender


def test_published_and_heard_over_the_loopback(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], loopback: Group
) -> None:
    packet, _ = ssl_packet(two_cameras(SSL_LENS))
    sender = in_background(packet, loopback)
    geometry, field, _ = received_geometry(loopback, 10.0)
    assert [calib["camera_id"] for calib in geometry["calib"]] == [0, 1]
    assert len(field.curves) == 13
    group = ["--address", loopback.address, "--port", str(loopback.port), "--interface", loopback.interface]
    assert main(["listen", "-o", str(tmp_path / "field.json"), *group]) == 0
    sender.join()
    assert "ssl-field with 25 points and 13 curves from 127.0.0.1:" in capsys.readouterr().out
    two_cameras(SSL_LENS).save(tmp_path / "c.json")
    assert main(["publish", str(tmp_path / "c.json"), "--once", *group]) == 0
    assert f"1 time to 224.5.23.9:{loopback.port}" in capsys.readouterr().out
    assert main(["listen", "-o", str(tmp_path / "field.pb"), "--seconds", "0.2", *group]) == 2
    assert "no geometry of a field within 0.2 s, but nothing at all" in capsys.readouterr().err


def sent_while_it_listens(packets: Mapping[bytes, str], seconds: float, group: Group) -> Any:
    """What is received while each packet is sent repeatedly to an address."""
    ends = threading.Event()

    def send() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(group.interface))
            while not ends.wait(0.01):
                for packet, address in packets.items():
                    sender.sendto(packet, (address, group.port))

    thread = threading.Thread(target=send)
    thread.start()
    try:
        return received_geometry(group, seconds)
    finally:
        ends.set()
        thread.join()


def no_field() -> bytes:
    """A packet of two cameras above a field with negative length."""
    packet, _ = ssl_packet(two_cameras(SSL_LENS))
    data = from_bytes("SSL_WrapperPacket", packet)
    data["geometry"]["field"]["field_length"] *= -1
    return to_bytes("SSL_WrapperPacket", data)


def test_a_packet_that_makes_no_field_does_not_end_listening(loopback: Group) -> None:
    packet, _ = ssl_packet(two_cameras(SSL_LENS))
    _, field, sender = sent_while_it_listens(
        {b"junk": loopback.address, no_field(): loopback.address, packet: loopback.address}, 5, loopback
    )
    assert len(field.curves) == 13 and sender.startswith("127.0.0.1:")
    with pytest.raises(InputError, match=r"within 0.2 s, but from 127\.0\.0\.1:\d+ .*field_length"):
        sent_while_it_listens({no_field(): loopback.address}, 0.2, loopback)


def test_only_what_is_sent_to_the_group_is_heard(loopback: Group) -> None:
    packet, _ = ssl_packet(two_cameras(SSL_LENS))
    with pytest.raises(InputError, match="but nothing at all"):
        sent_while_it_listens({packet: "127.0.0.1"}, 0.2, loopback)


@pytest.mark.parametrize("group", [("10.0.0.1", 10006), ("224.5.23.2", 70000), ("bogus", 10006)])
def test_groups_that_cannot_be(group: tuple[str, int]) -> None:
    with pytest.raises(InputError, match="give one from"):
        Group(*group)


def test_sigterm_ends_publishing_as_it_ends_other_commands(tmp_path: Path, loopback: Group) -> None:
    two_cameras(SSL_LENS).save(tmp_path / "c.json")
    program = "import sys; from ceres_cal.cli import main; sys.exit(main())"
    group = ["--address", loopback.address, "--port", str(loopback.port), "--interface", loopback.interface]
    words = [sys.executable, "-c", program, "publish", str(tmp_path / "c.json"), *group]
    process = subprocess.Popen(words, stderr=subprocess.PIPE, text=True)
    received_geometry(loopback, 20.0)
    time.sleep(0.3)  # it sleeps too, once it has counted the packet
    process.send_signal(signal.SIGTERM)
    assert f"files written: 1 packet to 224.5.23.9:{loopback.port}" in process.communicate(timeout=20)[1]
    assert process.returncode == 143


def test_commands(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    over_field(with_lens("radial-2-3")).save(tmp_path / "c.json")
    path = tmp_path / "geometry.yml"
    ask = ["export", str(tmp_path / "c.json"), "--to", "vision-processor", "-o", str(path)]
    assert main([*ask, "--max-loss-mm", "1"]) == 2
    assert "the export would be off by" in capsys.readouterr().err and not path.exists()
    assert main([*ask, "--camera-id", "1"]) == 0
    assert "mm at most, at 150 mm" in capsys.readouterr().out
    assert main(["import", str(path), "-o", str(tmp_path / "back.json")]) == 0
    assert "camera1: Camera(1280 x 960 px" in capsys.readouterr().out
    assert Calibration.load(tmp_path / "back.json").station().lens.names == ("a3",)
    assert main(["targets", "import", str(path), "-o", str(tmp_path / "t.json")]) == 0
    assert yaml.safe_load((tmp_path / "t.json").read_text()) == {"kind": "ssl-field", "division": "B"}


@pytest.mark.parametrize(
    "name, content, words",
    [
        ("a.pb", b"\x0a\xffhello", "not a SSL_WrapperPacket|holds no geometry"),
        ("a.pb", b"", "the packet holds no geometry"),
        ("a.yml", b"field:\n  field_length: [", "not valid YAML"),
        ("a.yml", b"field: 3\n", "it has no `field`"),
        ("a.yml", b"field: {field_length: 9000}\ncalib: []\n", "lacks field.field_width"),
        ("a.yml", b"field: {field_length: 9000, what: 3}\n", 'not what SSL_GeometryData holds.*"what"'),
        ("a.xml", b"<VarXML><Var", "not valid XML"),
        ("a.xml", b"<html></html>", "not a settings file of ssl-vision: it begins with <html>"),
        ("a.xml", b'<Var name="x">1</Var>', "not a settings file of ssl-vision: it begins with <Var>"),
        ("a.xml", b"<VarXML></VarXML>", "keeps its cameras in robocup-ssl.xml"),
        ("a.txt", b"hello", "its format is not recognised"),
    ],
)
def test_broken_files_are_one_line(name: str, content: bytes, words: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content)
    form = {"pb": "ssl-vision", "yml": "vision-processor", "xml": "ssl-vision-xml"}.get(name[2:])
    with pytest.raises(InputError, match=words) as caught:
        import_calibration(tmp_path / name, form)
    assert str(caught.value).startswith(str(tmp_path / name)) and len(str(caught.value).splitlines()) == 1


def test_a_calibration_without_a_field_asks_for_one(tmp_path: Path) -> None:
    bare = over_field(with_lens("brown"))
    alone = Calibration(**{**vars(bare), "targets": {}})
    with pytest.raises(InputError, match="the message needs a field, but the calibration has none"):
        export(alone, "ssl-vision", tmp_path / "a.pb")
    export(over_field(with_lens("radial-3")), "ssl-vision", tmp_path / "a.pb")
    export(alone, "ssl-vision", tmp_path / "a.pb")  # into a file that has one
    assert import_calibration(tmp_path / "a.pb").station().lens.kind == "radial"


@pytest.mark.parametrize("port", [0, -1, 65536, 10**30])
def test_a_port_that_is_none_is_refused(port: int) -> None:
    with pytest.raises(InputError, match=r"port .*: give one from 1 to 65535"):
        Group(port=port)
