"""The RoboCup small-size league's messages, as far as they concern geometry and where things are seen.

src RoboCup-SSL/ssl-vision src/shared/proto: names, numbers and types as published there; TIGERs-Mannheim's
vision-processor has the same. Compiled here by `protobuf` into a pool of their own, beside whatever the caller has.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import cache
from typing import Any

from ceres_cal.base.errors import InputError, attempt

_DEFINITION = """
enum SSL_Source { SSL_SOURCE_UNKNOWN = 0; SSL_SOURCE_OTHER = 1; SSL_SOURCE_SSL_VISION = 2;
  SSL_SOURCE_VISION_PROCESSOR = 3; SSL_SOURCE_GRSIM = 4; SSL_SOURCE_ERFORCE_SIM = 5; }
enum SSL_FieldShapeType { Undefined = 0; CenterCircle = 1; TopTouchLine = 2; BottomTouchLine = 3; LeftGoalLine = 4;
  RightGoalLine = 5; HalfwayLine = 6; CenterLine = 7; LeftPenaltyStretch = 8; RightPenaltyStretch = 9;
  LeftFieldLeftPenaltyStretch = 10; LeftFieldRightPenaltyStretch = 11; RightFieldLeftPenaltyStretch = 12;
  RightFieldRightPenaltyStretch = 13; }
message Vector2f { required float x = 1; required float y = 2; }
message SSL_FieldLineSegment { required string name = 1; required Vector2f p1 = 2; required Vector2f p2 = 3;
  required float thickness = 4; optional SSL_FieldShapeType type = 5; }
message SSL_FieldCircularArc { required string name = 1; required Vector2f center = 2; required float radius = 3;
  required float a1 = 4; required float a2 = 5; required float thickness = 6; optional SSL_FieldShapeType type = 7; }
message SSL_GeometryFieldSize { required int32 field_length = 1; required int32 field_width = 2;
  required int32 goal_width = 3; required int32 goal_depth = 4; required int32 boundary_width = 5;
  repeated SSL_FieldLineSegment field_lines = 6; repeated SSL_FieldCircularArc field_arcs = 7;
  optional int32 penalty_area_depth = 8; optional int32 penalty_area_width = 9;
  optional int32 center_circle_radius = 10; optional int32 line_thickness = 11;
  optional int32 goal_center_to_penalty_mark = 12; optional int32 goal_height = 13; optional float ball_radius = 14;
  optional float max_robot_radius = 15; optional int32 boundary_width_goal_line = 16;
  optional int32 goal_substitution_area_width = 17; }
message SSL_GeometryCameraCalibration { required uint32 camera_id = 1; required float focal_length = 2;
  required float principal_point_x = 3; required float principal_point_y = 4; required float distortion = 5;
  required float q0 = 6; required float q1 = 7; required float q2 = 8; required float q3 = 9;
  required float tx = 10; required float ty = 11; required float tz = 12;
  optional float derived_camera_world_tx = 13; optional float derived_camera_world_ty = 14;
  optional float derived_camera_world_tz = 15; optional uint32 pixel_image_width = 16;
  optional uint32 pixel_image_height = 17; }
message SSL_BallModelStraightTwoPhase { required double acc_slide = 1; required double acc_roll = 2;
  required double k_switch = 3; }
message SSL_BallModelChipFixedLoss { required double damping_xy_first_hop = 1;
  required double damping_xy_other_hops = 2; required double damping_z = 3; }
message SSL_GeometryModels { optional SSL_BallModelStraightTwoPhase straight_two_phase = 1;
  optional SSL_BallModelChipFixedLoss chip_fixed_loss = 2; }
message SSL_GeometryData { required SSL_GeometryFieldSize field = 1;
  repeated SSL_GeometryCameraCalibration calib = 2; optional SSL_GeometryModels models = 3; }
message SSL_WrapperPacket { optional bytes detection = 1; optional SSL_GeometryData geometry = 2;
  optional SSL_Source source = 3; }
"""
_LABELS = {"optional": 1, "required": 2, "repeated": 3}
_TYPES = {"double": 1, "float": 2, "int32": 5, "string": 9, "bytes": 12, "uint32": 13}
_MESSAGE, _ENUM = 11, 14


@cache
def message_class(name: str) -> Any:
    """The class of a message."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    file = descriptor_pb2.FileDescriptorProto(name="ceres_cal_ssl.proto", syntax="proto2")
    enums = {found[1] for found in re.finditer(r"enum (\w+)", _DEFINITION)}
    for kind, title, body in re.findall(r"(enum|message) (\w+) \{(.*?)\}", _DEFINITION, re.DOTALL):
        if kind == "enum":
            enum = file.enum_type.add(name=title)
            for value, number in re.findall(r"(\w+) = (\d+);", body):
                enum.value.add(name=value, number=int(number))
            continue
        message = file.message_type.add(name=title)
        for label, type_name, field, number in re.findall(r"(\w+) (\w+) (\w+) = (\d+);", body):
            plain = _TYPES.get(type_name, _ENUM if type_name in enums else _MESSAGE)
            of = {} if type_name in _TYPES else {"type_name": f".{type_name}"}
            message.field.add(name=field, number=int(number), label=_LABELS[label], type=plain, **of)
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(name))


def to_bytes(name: str, data: Mapping[str, Any]) -> bytes:
    """Plain data under the names of a message, encoded.

    Raises:
        InputError: a name that the message does not have, a required one missing, or a value of another type.
    """
    from google.protobuf import json_format

    try:
        message = json_format.ParseDict(data, message_class(name)())
    except (json_format.ParseError, OverflowError) as error:
        raise InputError(f"not what {name} holds: {error}") from None
    if not message.IsInitialized():
        raise InputError(f"{name} lacks {message.FindInitializationErrors()[0]}")
    return bytes(message.SerializeToString())


def from_bytes(name: str, content: bytes) -> dict[str, Any]:
    """What an encoded message says, under its names.

    Raises:
        InputError: it is none (cut short?), or lacks something that is required.
    """
    from google.protobuf import json_format
    from google.protobuf.message import DecodeError

    message = message_class(name)()
    try:
        message.ParseFromString(content)
    except (DecodeError, RuntimeError):
        raise InputError(f"not a {name} (cut short?)") from None
    if not message.IsInitialized():
        raise InputError(f"not a {name}: it lacks {message.FindInitializationErrors()[0]}")
    return dict(json_format.MessageToDict(message, preserving_proto_field_name=True))


def geometry_from_bytes(content: bytes) -> dict[str, Any]:
    """An SSL_GeometryData, or that of an SSL_WrapperPacket, as plain data.

    Raises:
        InputError: neither, or a packet without geometry.
    """
    geometry = attempt(lambda: from_bytes("SSL_GeometryData", content))  # quiet: the other one's failure is told
    if isinstance(geometry, dict):
        return geometry
    packet = from_bytes("SSL_WrapperPacket", content)
    if "geometry" not in packet:
        raise InputError("the packet holds no geometry")
    return dict(packet["geometry"])
