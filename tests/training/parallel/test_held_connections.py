"""Connections to a port outlast the process that they were made to, until they are released."""

import selectors
import socket
import subprocess
import sys

import pytest

# Says its two ports, accepts a connection to each, and holds those to the first.
SERVER = """
import socket
from logvggt_jax.training.parallel import held_connections
held_connections._SECONDS = 3
servers = [socket.create_server(("localhost", 0)) for _ in range(2)]
ports = [server.getsockname()[1] for server in servers]
print(*ports, flush=True)
connections = [server.accept()[0] for server in servers]
held = held_connections.HeldConnections(ports[0])
print("held", flush=True)
input()
held.release()
"""


@pytest.mark.parametrize("released", [False, True])
def test_connections_to_the_port_outlast_a_kill(released: bool) -> None:
    options = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", SERVER], **options) as server:
        assert server.stdin is not None and server.stdout is not None
        ports = [int(port) for port in server.stdout.readline().split()]
        held, other = (socket.create_connection(("localhost", port), timeout=10) for port in ports)
        with held, other, selectors.DefaultSelector() as selector:
            assert server.stdout.readline() == "held\n"
            if released:
                server.communicate("\n", timeout=10)
                assert server.returncode == 0
            else:
                server.kill()
            assert other.recv(1) == b"", "one that nobody holds closes with its process"
            selector.register(held, selectors.EVENT_READ)
            closed = [key.fileobj for key, _ in selector.select(10 if released else 0.3)]
            assert closed == ([held] if released else [])
            if not released:
                assert held.recv(1) == b"", "after a while it closes all the same"
