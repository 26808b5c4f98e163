import socket
import struct
import threading

import pytest

from grindvision.errors import InputError, SendError
from grindvision.motion import announcement, send_urscript

SCRIPT = "def follow_seam():\n  movej([0, 0, 0, 0, 0, 0])\nend\n"
#: Larger than the buffers between two sockets, so that it cannot vanish into them unread.
LONG_SCRIPT = "def follow_seam():\n" + "  movej([0, 0, 0, 0, 0, 0])\n" * 400_000 + "end\n"


#: A time that no answer takes, however busy the machine.
PATIENCE_S = 300.0


class Controller:
    """A robot controller on loopback that greets, listens and answers as ``behave`` says, in its own thread."""

    def __init__(self, behave):
        self.behave = behave
        self.heard = b""
        self.server = socket.create_server(("127.0.0.1", 0))
        self.server.settimeout(PATIENCE_S)
        self.port = self.server.getsockname()[1]
        self.thread = threading.Thread(target=self.serve, daemon=True)

    def serve(self):
        try:
            connection, _ = self.server.accept()
        except OSError:
            return
        connection.settimeout(PATIENCE_S)
        with connection:
            self.behave(self, connection)

    def greeted_on(self, connection):
        """The connection, once the greeting waits in it: the short time-outs here are for what comes after."""
        given_s = connection.gettimeout()
        connection.settimeout(PATIENCE_S)
        connection.recv(1, socket.MSG_PEEK)
        connection.settimeout(given_s)
        return connection

    def listen(self, connection):
        while not self.heard.endswith(b"\nend\n") and (block := connection.recv(65536)):
            self.heard += block

    def __enter__(self):
        self.thread.start()
        return self

    def __exit__(self, *_):
        self.server.close()
        self.thread.join(timeout=PATIENCE_S)


def proper(controller, connection):
    connection.sendall(b"state" * 100)
    controller.listen(connection)
    connection.sendall(b"state" * 100)


def silent(controller, connection):
    controller.listen(connection)


def closing_at_once(controller, connection):
    pass


def closing_after_the_greeting(controller, connection):
    connection.sendall(b"state")
    connection.recv(1)


def breaking_off(controller, connection):
    connection.sendall(b"state")
    controller.heard = connection.recv(1000)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # reset instead of goodbye


def deaf_afterwards(controller, connection):
    connection.sendall(b"state")
    controller.listen(connection)
    connection.recv(1)  # until the sender gives up


def test_the_controller_gets_every_byte():
    with Controller(proper) as controller:
        delivery = send_urscript(SCRIPT, "127.0.0.1", controller.port, PATIENCE_S)
        controller.thread.join(timeout=PATIENCE_S)
    assert controller.heard == SCRIPT.encode()
    assert str(delivery) == f"{len(SCRIPT)} bytes sent to 127.0.0.1:{controller.port}"


def test_a_long_programme_arrives_whole():
    with Controller(proper) as controller:
        assert send_urscript(LONG_SCRIPT, "127.0.0.1", controller.port, PATIENCE_S).sent_bytes == len(LONG_SCRIPT)
        controller.thread.join(timeout=PATIENCE_S)
    assert controller.heard == LONG_SCRIPT.encode()


def test_a_closed_port_is_named():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    with pytest.raises(SendError, match=rf"127.0.0.1:{port}: Connection refused.*nothing was sent"):
        send_urscript(SCRIPT, "127.0.0.1", port)


def test_an_unknown_host_is_named(monkeypatch):
    def unknown(*_, **__):
        raise socket.gaierror(-2, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    with pytest.raises(SendError, match=r"robot.invalid:30002: no such host.*nothing was sent"):
        send_urscript(SCRIPT, "robot.invalid")


@pytest.mark.parametrize(
    ("behave", "timeout_s", "complaint"),
    [(silent, 0.3, "silent for 0.3 s"), (closing_at_once, PATIENCE_S, "closed the connection")],
)
def test_nothing_is_sent_to_what_does_not_speak_first(behave, timeout_s, complaint):
    with Controller(behave) as controller:
        with pytest.raises(SendError, match=f"{complaint}.*nothing was sent"):
            send_urscript(SCRIPT, "127.0.0.1", controller.port, timeout_s)
        controller.thread.join(timeout=PATIENCE_S)
    assert controller.heard == b""


@pytest.mark.parametrize(
    ("behave", "timeout_s", "script", "complaint"),
    [
        (closing_after_the_greeting, PATIENCE_S, SCRIPT, "went out but may not have been taken|nothing runs"),
        (breaking_off, PATIENCE_S, LONG_SCRIPT, "without its final 'end' nothing runs"),
        (deaf_afterwards, 0.3, SCRIPT, "silent for 0.3 s.*may not have been taken"),
    ],
)
def test_a_socket_that_closes_on_the_way_is_named(behave, timeout_s, script, complaint, monkeypatch):
    with Controller(behave) as controller, pytest.raises(SendError, match=complaint):
        connect = socket.create_connection
        monkeypatch.setattr(socket, "create_connection", lambda *a, **k: controller.greeted_on(connect(*a, **k)))
        send_urscript(script, "127.0.0.1", controller.port, timeout_s)
    assert b"\nend\n" not in controller.heard or behave is deaf_afterwards


@pytest.mark.parametrize(
    "script", ["", "movej([0])\n", SCRIPT[:-5], SCRIPT.rstrip("\n"), SCRIPT.replace("seam", "näht")]
)
def test_half_a_programme_is_refused_before_anyone_is_called(script):
    with socket.create_server(("127.0.0.1", 0)) as server:
        with pytest.raises(InputError, match="no whole programme"):
            send_urscript(script, "127.0.0.1", server.getsockname()[1])
        server.setblocking(False)
        with pytest.raises(BlockingIOError):
            server.accept()


@pytest.mark.parametrize("where", [{"host": ""}, {"host": "a", "port": 0}, {"host": "a", "timeout_s": 0.0}])
def test_an_address_that_is_none_is_refused(where):
    with pytest.raises(InputError, match="cannot send to"):
        send_urscript(SCRIPT, **where)


@pytest.mark.parametrize("host", ["8.8.8.8", "172.32.0.1", "2001:4860:4860::8888"])
def test_an_address_outside_private_networks_is_refused_before_any_connection(monkeypatch, host):
    monkeypatch.setattr(socket, "create_connection", lambda *a, **k: pytest.fail("it connected"))
    with pytest.raises(SendError, match=r"no address of a private network.*nothing was sent"):
        send_urscript("def f():\nend\n", host)


def test_what_will_be_sent_is_announced():
    dry = announcement("def f():\n  set_tcp(p[0,0,0,0,0,0])\n  movej([0], a=1)\nend\n", "10.0.0.2")
    assert "10.0.0.2:30002" in dry and "1 moves" in dry and "the arc stays off" in dry
    assert "1 outputs" in announcement("def f():\n  set_digital_out(1, True)\nend\n", "10.0.0.2")
