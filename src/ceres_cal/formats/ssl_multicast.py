"""The league's geometry over UDP multicast: sent as ssl-vision and vision-processor do, and received."""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from ceres_cal.base.errors import InputError
from ceres_cal.formats.ssl_messages import from_bytes, to_bytes

_LARGEST = 65536
_TTL = 1  # stays in the local network


@dataclass(frozen=True)
class Group:
    """Where vision is published.

    Attributes:
        interface: address of the own network card, 0.0.0.0 for the system's choice.
    """

    address: str = "224.5.23.2"
    port: int = 10006
    interface: str = "0.0.0.0"

    def __post_init__(self) -> None:
        if not 0 < self.port < 65536:
            raise InputError(f"port {self.port:.6g}: give one from 1 to 65535")


def wrapped(geometry: Mapping[str, Any]) -> bytes:
    """The wrapper packet of an SSL_GeometryData as plain data; vision-processor takes over any for its camera's id."""
    return to_bytes("SSL_WrapperPacket", {"geometry": dict(geometry), "source": "SSL_SOURCE_OTHER"})


def publish(packet: bytes, group: Group, times: int | None = None, period_s: float = 3.0) -> int:
    """Send a packet so many times, or until it is interrupted; how often it was sent.

    Raises:
        InputError: the network does not take it.
    """
    sent = 0
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, _TTL)
            sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_LOOP, 1)
            if group.interface != "0.0.0.0":
                sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(group.interface))
            while times is None or sent < times:
                sender.sendto(packet, (group.address, group.port))
                sent += 1
                if sent != times:
                    time.sleep(period_s)
    except KeyboardInterrupt:
        pass
    except OSError as error:
        raise InputError(f"{group.address}:{group.port}: cannot be sent to: {error.strerror or error}") from None
    return sent


def received_geometry(group: Group, seconds: float) -> dict[str, Any]:
    """The first geometry that comes within a time, as plain data.

    Raises:
        InputError: none comes, or the network cannot be listened to.
    """
    count = 0
    for content in _packets(group, seconds):
        count += 1
        try:
            packet = from_bytes("SSL_WrapperPacket", content)
        except InputError:
            continue
        if "geometry" in packet:
            return dict(packet["geometry"])
    heard = f"{count} packets without it" if count else "nothing at all: is vision running, and on this network card?"
    raise InputError(f"{group.address}:{group.port}: no geometry within {seconds:g} s, but {heard}")


def _packets(group: Group, seconds: float) -> Iterator[bytes]:
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
            receiver.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            receiver.bind(("", group.port))
            member = struct.pack("4s4s", socket.inet_aton(group.address), socket.inet_aton(group.interface))
            receiver.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
            ends = time.monotonic() + seconds
            while (left := ends - time.monotonic()) > 0.0:
                receiver.settimeout(left)
                try:
                    yield receiver.recv(_LARGEST)
                except TimeoutError:
                    return
    except OSError as error:
        raise InputError(f"{group.address}:{group.port}: cannot be listened to: {error.strerror or error}") from None
