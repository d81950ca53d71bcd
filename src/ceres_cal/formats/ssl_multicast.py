"""The league's geometry over UDP multicast, sent and received as by ssl-vision and vision-processor.

Also what the commands need of it: a packet to send, and the field of a received packet or of a file.
"""

from __future__ import annotations

import re
import socket
import struct
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from select import select
from typing import TYPE_CHECKING, Any

from msgspec import Struct

from ceres_cal.base import InputError, first_of, naming, note, plural, read_bytes
from ceres_cal.formats.format import Export, ExportRequest
from ceres_cal.formats.ssl_fields import target_of
from ceres_cal.formats.ssl_geometry import geometry_of, read_geometry
from ceres_cal.formats.ssl_messages import from_bytes, to_bytes
from ceres_cal.formats.ssl_settings import settings_target, values_in
from ceres_cal.formats.yaml_files import yaml_text
from ceres_cal.scene.targets import Target

if TYPE_CHECKING:
    from ceres_cal.calibration import Calibration


class Group(Struct, frozen=True):
    """Multicast group on which vision is published.

    Attributes:
        address: of the multicast group. interface: address of this computer's network card, 0.0.0.0 for the system's
            choice.

    Raises:
        InputError: an invalid address or port.
    """

    address: str = "224.5.23.2"
    port: int = 10006
    interface: str = "0.0.0.0"

    def __post_init__(self) -> None:
        if not 0 < self.port < 65536:
            raise InputError(f"port {self.port:.6g}: give one from 1 to 65535")
        if not re.fullmatch(r"2(2[4-9]|3\d)(\.\d{1,3}){3}", self.address):
            raise InputError(f"{self.address} is not a multicast group: give one from 224.0.0.0 to 239.255.255.255")


def wrapped(geometry: Mapping[str, Any]) -> bytes:
    """Return the wrapper packet of an SSL_GeometryData as plain data; vision-processor accepts any with its id."""
    return to_bytes("SSL_WrapperPacket", {"geometry": dict(geometry), "source": "SSL_SOURCE_OTHER"})


def publish(packet: bytes, group: Group, times: int | None = None, period_s: float = 3.0) -> int:
    """Send a packet so many times, without end for None; return the number of packets sent. If it is interrupted, the
    number is recorded by `base.errors.note`.

    Raises:
        InputError: the network does not accept it.
    """
    ttl = 1  # stays in the local network
    sent = 0
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, ttl)
            sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_LOOP, 1)
            if group.interface != "0.0.0.0":
                sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(group.interface))
            while times is None or sent < times:
                sender.sendto(packet, (group.address, group.port))
                sent += 1
                if sent != times:
                    time.sleep(period_s)
    except OSError as error:
        raise InputError(f"{group.address}:{group.port}: cannot be sent to: {error.strerror or error}") from None
    finally:
        if sent:
            note(f"{plural(sent, 'packet')} to {group.address}:{group.port}")
    return sent


def received_geometry(group: Group, seconds: float) -> tuple[dict[str, Any], Target, str]:
    """Wait for the first geometry of a valid field; return it as plain data, the field, and the sender's address and
    port. Other packets are ignored.

    Raises:
        InputError: none arrives in time (the message names the senders of others, and what is wrong with the last), the
            address is no multicast group, or the network cannot be listened to.
    """
    refused: dict[str, str] = {}
    for content, sender in _packets(group, seconds):
        try:
            packet = from_bytes("SSL_WrapperPacket", content)
            if "geometry" not in packet:
                raise InputError("a packet without geometry")
            return dict(packet["geometry"]), target_of(packet["geometry"]["field"]), sender
        except InputError as error:  # reads: "no geometry of a field within 10 s, but from 10.0.0.7:10006 ..."
            refused[sender] = str(error)
    heard = first_of([f"from {sender} {why}" for sender, why in refused.items()])
    heard = heard or "nothing at all: is vision running, and on this network card?"
    raise InputError(f"{group.address}:{group.port}: no geometry of a field within {seconds:g} s, but {heard}")


def _packets(group: Group, seconds: float) -> Iterator[tuple[bytes, str]]:
    """Yield packets to the group, but not those to an address of this computer, and the sender of each."""
    ip_multicast_all = 49  # constant of Linux, which Python does not name
    look_s = 60.0  # longest single wait, as select does not accept any number
    largest = 65536
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
            receiver.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            # Otherwise packets of groups that other programs joined on other network cards arrive, too.
            if sys.platform == "linux":
                receiver.setsockopt(socket.IPPROTO_IP, ip_multicast_all, 0)
            receiver.bind((group.address, group.port))
            member = struct.pack("4s4s", socket.inet_aton(group.address), socket.inet_aton(group.interface))
            receiver.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
            ends = time.monotonic() + seconds
            while (left := ends - time.monotonic()) > 0.0:
                if select([receiver], [], [], min(left, look_s))[0]:
                    content, sender = receiver.recvfrom(largest)
                    yield content, f"{sender[0]}:{sender[1]}"
    except OSError as error:
        raise InputError(f"{group.address}:{group.port}: cannot be listened to: {error.strerror or error}") from None


def ssl_packet(
    calibration: Calibration, stations: Sequence[str] | None = None, camera_id: str = "", before: Path | None = None
) -> tuple[bytes, Export]:
    """Return the wrapper packet of a calibration, and its errors.

    Args:
        before: a geometry.yml or a packet with the field and other cameras; by default the calibration's field.

    Raises:
        InputError: no such station, no field, or camera ids that do not fit; naming the file, no geometry in it.
    """
    names = tuple(calibration.stations if stations is None else stations)
    for name in names:
        calibration.station(name)
    request = ExportRequest(calibration, names, "")
    with naming(before):
        shown = {} if before is None else read_geometry(read_bytes(before))
    data, exported = geometry_of(request, camera_id, shown)
    return wrapped(data), exported


def geometry_content(geometry: Mapping[str, Any], ending: str) -> bytes:
    """Return an SSL_GeometryData, given as plain data, as the content of a file."""
    return to_bytes("SSL_GeometryData", geometry) if ending == ".pb" else yaml_text(geometry).encode()


def read_ssl_target(path: str | Path) -> Target:
    """Read the field of a geometry.yml, a packet or ssl-vision's robocup-ssl.xml.

    Raises:
        InputError: naming the file; it is none of these, or has no field.
    """
    content = read_bytes(path)
    with naming(path):
        return (
            settings_target(values_in(content)) if b"<VarXML" in content else target_of(read_geometry(content)["field"])
        )
