"""Hand a URScript programme over to a robot's controller by TCP."""

from __future__ import annotations

import ipaddress
import socket
from dataclasses import dataclass

from grindvision.errors import InputError, SendError

#: The port on which a UR controller streams its state and takes programmes.
UR_PORT = 30002


#: Networks in which a robot may stand: private, link-local and loop-back addresses (RFC 1918, 3927, 4193, 4291).
PRIVATE = tuple(
    ipaddress.ip_network(text)
    for text in (
        "10.0.0.0/8",
        "172.16.0.0/12",
        "192.168.0.0/16",
        "169.254.0.0/16",
        "127.0.0.0/8",
        "fc00::/7",
        "fe80::/10",
        "::1/128",
    )
)


@dataclass(frozen=True)
class Delivery:
    """A programme of ``sent_bytes`` that the controller at ``host``:``port`` took."""

    host: str
    port: int
    sent_bytes: int

    def __str__(self) -> str:
        return f"{self.sent_bytes} bytes sent to {self.host}:{self.port}"


def announcement(script: str, host: str, port: int = UR_PORT) -> str:
    """What sending a programme would do, in one line: where it goes, how it moves, whether it switches anything."""
    lines = [line.strip() for line in script.splitlines()]
    moves = sum(line.startswith(("movej(", "movel(", "movep(", "movec(")) for line in lines)
    outputs = sum(line.startswith("set_") and not line.startswith("set_tcp") for line in lines)
    arc = f"{outputs} outputs or settings are set" if outputs else "no output is set, the arc stays off"
    size = len(script.encode("utf-8", "replace"))
    return f"{host}:{port} will get {size} bytes of URScript and the arm will move at once: {moves} moves, {arc}"


def send_urscript(
    script: str, host: str, port: int = UR_PORT, timeout_s: float = 3.0, *, anywhere: bool = False
) -> Delivery:
    """Send a whole URScript programme to a controller that listens, and see that it is still there afterwards.

    A UR controller speaks first and never stops: it streams its state. So nothing is sent before it has been heard,
    and it must be heard again after the last byte. It runs nothing before the programme's final ``end`` has arrived:
    what breaks off on the way is thrown away there. A host outside private networks is refused unless ``anywhere``.

    Raises:
        InputError: the script is no whole programme, or host, port or time-out make no sense.
        SendError: an address that is not private, refused, unknown host, silent, or closed on the way; the message says
            what was sent.
    """
    if not (script.isascii() and script.startswith("def ") and script.endswith("\nend\n")):
        raise InputError("the script is no whole programme: ASCII text from 'def' to a last line 'end'; write it anew")
    if not host or not 0 < port < 65536 or not timeout_s > 0:
        raise InputError(f"cannot send to host {host!r}, port {port}, time-out {timeout_s} s; give all three, above 0")
    data = script.encode("ascii")
    place = f"{host}:{port}"
    try:
        address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][4][0]
        _check_private(str(address), place, anywhere)
        connection = socket.create_connection((str(address), port), timeout=timeout_s)
    except socket.gaierror:
        raise SendError(f"{place}: no such host; check the robot's address; nothing was sent") from None
    except TimeoutError:
        raise SendError(f"{place}: no connection within {timeout_s:g} s; is the robot on? nothing was sent") from None
    except OSError as error:
        reason = error.strerror or error
        raise SendError(f"{place}: {reason}; is the robot on and in remote control? nothing was sent") from None
    with connection:
        _hear(connection, place, timeout_s, "nothing was sent")
        _drain(connection, timeout_s)
        try:
            connection.sendall(data)
        except OSError as error:
            raise SendError(
                f"{place}: closed while taking the programme ({error.strerror or error}); without its final 'end'"
                " nothing runs; send it again"
            ) from None
        _hear(
            connection,
            place,
            timeout_s,
            f"all {len(data)} bytes went out but may not have been taken; look before resending",
        )
    return Delivery(host, port, len(data))


def _check_private(address: str, place: str, anywhere: bool) -> None:
    number = ipaddress.ip_address(address.partition("%")[0])
    if not anywhere and not any(number in network for network in PRIVATE):
        raise SendError(
            f"{place}: {address} is no address of a private network, and a robot belongs in none but a private one;"
            " check the address, or allow it with anywhere (--anywhere); nothing was sent"
        )


def _hear(connection: socket.socket, place: str, timeout_s: float, sent: str) -> None:
    try:
        heard = connection.recv(65536)
    except TimeoutError:
        raise SendError(f"{place}: silent for {timeout_s:g} s, as no UR controller is; {sent}") from None
    except OSError as error:
        raise SendError(f"{place}: the connection broke ({error.strerror or error}); {sent}") from None
    if not heard:
        raise SendError(f"{place}: the controller closed the connection; {sent}")


def _drain(connection: socket.socket, timeout_s: float) -> None:
    """Throw away what was heard already, so that what is heard next was said after the programme."""
    connection.setblocking(False)
    try:
        while connection.recv(65536):
            pass
    except OSError:
        pass  # nothing more is waiting; a broken connection shows at the next send
    connection.settimeout(timeout_s)
