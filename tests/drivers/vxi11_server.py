"""A VXI-11 core channel (VXI-11 1.0, over ONC RPC) in front of a simulated instrument."""

import socketserver
import struct
import threading
import time

from drivers.emulators.serving import (
    UnpluggedError,
    interrupt,
    unterminated,
)

CORE_PROGRAM, CORE_VERSION = 0x0607AF, 1
PORT_MAPPER, GET_PORT = 100_000, 3
CREATE_LINK, WRITE, READ, STATUS, CLEAR, DESTROY_LINK = 10, 11, 12, 13, 15, 23
NO_ERROR, INVALID_LINK, TIMED_OUT = 0, 4, 15
END_FLAG, END_REASON, COUNT_REASON = 8, 4, 1
LINK, MOST_BYTES = 7, 1024
LAST_FRAGMENT = 0x8000_0000
CALL, REPLY = 0, 1
POLL_S = 0.01


class Vxi11Server:
    """Serves a `EmulatedDevice` on a port of this computer, to one caller at a time.

    Parameters
    ----------
    device : EmulatedDevice
        May be a `FaultyWire`; where that is unplugged, the server hangs up.
    port_mapper_port : int, optional
        Also answer there where the core channel is; 111 is the port that all callers ask.

    Attributes
    ----------
    port : int
        On 127.0.0.1.
    """

    def __init__(self, device, port_mapper_port=None):
        self._device = device
        self._command, self._answers = b"", b""
        self._servers = [_serve(0, self._answer)]
        self.port = self._servers[0].server_address[1]
        if port_mapper_port is not None:
            self._servers.append(_serve(port_mapper_port, self._answer))

    def close(self):
        for server in self._servers:
            server.shutdown()
            server.server_close()

    def _answer(self, program, procedure, arguments):
        """Return the results of a remote procedure."""
        if program == PORT_MAPPER:
            assert procedure == GET_PORT
            assert struct.unpack(">II", arguments[:8]) == (CORE_PROGRAM, CORE_VERSION)
            return struct.pack(">I", self.port)
        assert program == CORE_PROGRAM
        if procedure == CREATE_LINK:
            return struct.pack(">iiII", NO_ERROR, LINK, 0, MOST_BYTES)
        if struct.unpack_from(">i", arguments)[0] != LINK:
            return struct.pack(">iII", INVALID_LINK, 0, 0)
        if procedure == WRITE:
            return self._write(arguments)
        if procedure == READ:
            return self._read(arguments)
        if procedure == STATUS:
            return struct.pack(">iI", NO_ERROR, 16 if self._answers else 0)
        if procedure == CLEAR:
            self._command, self._answers = b"", b""
        else:
            assert procedure == DESTROY_LINK
        return struct.pack(">i", NO_ERROR)

    def _write(self, arguments):
        flags, size = struct.unpack_from(">II", arguments, 12)
        assert size <= MOST_BYTES
        self._command += arguments[20 : 20 + size]
        if flags & END_FLAG:
            command, self._command = self._command.rstrip(b"\n") + b"\n", b""
            if self._answers:
                interrupt(self._device)
            self._answers = self._device.receive(command)
        return struct.pack(">iI", NO_ERROR, size)

    def _read(self, arguments):
        count, timeout_ms = struct.unpack_from(">II", arguments, 4)
        if not self._answers:
            unterminated(self._device)
            time.sleep(timeout_ms / 1000)
            return struct.pack(">iiI", TIMED_OUT, 0, 0)
        data, self._answers = self._answers[:count], self._answers[count:]
        reason = COUNT_REASON if self._answers else END_REASON
        return struct.pack(">iiI", NO_ERROR, reason, len(data)) + data + bytes(-len(data) % 4)


class _Server(socketserver.ThreadingTCPServer):
    allow_reuse_address = daemon_threads = True
    block_on_close = False


def _serve(port, answer):
    class Handler(socketserver.StreamRequestHandler):
        def handle(self):
            while header := self.rfile.read(4):
                length = struct.unpack(">I", header)[0]
                assert length & LAST_FRAGMENT, "a caller that cuts its calls is not needed here"
                try:
                    reply = _replied(self.rfile.read(length & ~LAST_FRAGMENT), answer)
                except UnpluggedError:
                    return
                self.wfile.write(struct.pack(">I", LAST_FRAGMENT | len(reply)) + reply)

    server = _Server(("127.0.0.1", port), Handler)
    threading.Thread(target=server.serve_forever, args=(POLL_S,), daemon=True).start()
    return server


def _replied(call, answer):
    """Return the reply to one call of ONC RPC (RFC 5531)."""
    transaction, kind, _, program, _, procedure = struct.unpack_from(">6I", call)
    assert kind == CALL
    start = 24
    for _ in ("credentials", "verifier"):
        start += 8 + struct.unpack_from(">I", call, start + 4)[0]
    return struct.pack(">6I", transaction, REPLY, 0, 0, 0, 0) + answer(
        program, procedure, call[start:]
    )
