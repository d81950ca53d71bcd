"""Messages of the RoboCup small-size league, as far as they concern geometry and where things are seen.

They are defined in `ssl_messages.proto`, from RoboCup-SSL/ssl-vision src/shared/proto; TIGERs-Mannheim's
vision-processor has the same. `protobuf` compiles them into a pool of their own, which does not conflict with the
caller's.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import cache
from importlib.resources import files
from typing import Any

from ceres_cal.base.errors import InputError, attempt

_LABELS = {"optional": 1, "required": 2, "repeated": 3}
_TYPES = {"double": 1, "float": 2, "int32": 5, "string": 9, "bytes": 12, "uint32": 13}
_MESSAGE, _ENUM = 11, 14


@cache
def message_class(name: str) -> Any:
    """Return the class of a message."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    definition = files("ceres_cal.formats").joinpath("ssl_messages.proto").read_text(encoding="utf-8")
    file = descriptor_pb2.FileDescriptorProto(name="ceres_cal_ssl.proto", syntax="proto2")
    enums = {found[1] for found in re.finditer(r"enum (\w+)", definition)}
    for kind, title, body in re.findall(r"(enum|message) (\w+) \{(.*?)\}", definition, re.DOTALL):
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
    """Encode plain data under the names of a message.

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
    """Decode a message into plain data under its names.

    Raises:
        InputError: it is not such a message (cut short?), or lacks a required value.
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
    """Decode an SSL_GeometryData, or that of an SSL_WrapperPacket, into plain data.

    Raises:
        InputError: neither, or a packet without geometry.
    """
    geometry = attempt(lambda: from_bytes("SSL_GeometryData", content))  # quiet: the other one's failure is reported
    if isinstance(geometry, dict):
        return geometry
    packet = from_bytes("SSL_WrapperPacket", content)
    if "geometry" not in packet:
        raise InputError("the packet holds no geometry")
    return dict(packet["geometry"])
