"""The plant in real time with the C node as a separate process: camera on the bus, board behind a Unix socket."""

from __future__ import annotations

import socket
import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from firmware_py.bus.port import Port
from hil.plant_process import CHUNK_NS, PlantProcess
from hil.reference_node.board import Answer, Request, take_boards
from hil.scenario import Scenario

ACCEPT_S = 0.1
"""Period at which the server checks whether it has been closed."""


class BoardServer:
    """Connection of one node: its requests queue in `requests`, in order; `arrival` is set when one comes in."""

    def __init__(self, path: Path, arrival: threading.Event) -> None:
        self.requests: deque[Request] = deque()
        self._arrival = arrival
        self._closed = False
        self._connection: socket.socket | None = None
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._listener.bind(str(path))
        self._listener.listen(1)
        self._listener.settimeout(ACCEPT_S)
        self._thread = threading.Thread(target=self._read, name="board", daemon=True)
        self._thread.start()

    def answer(self, answer: Answer) -> None:
        """Sends `answer` to the node; does nothing when the node is not connected."""
        if self._connection is not None:
            try:
                self._connection.send(bytes(answer))
            except OSError:
                self._connection = None

    def close(self) -> None:
        """Shuts the connection down, which ends the node, and stops the server."""
        self._closed = True
        if self._connection is not None:
            self._connection.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        self._listener.close()

    def _read(self) -> None:
        while not self._closed:
            try:
                connection, _ = self._listener.accept()
            except TimeoutError:
                continue
            with connection:
                self._connection = connection
                while data := connection.recv(4096):
                    self.requests.append(Request.from_buffer_copy(data))
                    self._arrival.set()
                self._connection = None


class SocketPlant(PlantProcess):
    """A plant of one module whose MCU is the C node behind the Unix socket `path`."""

    def __init__(self, scenario: Scenario, seed: int, rate_hz: int, out: Path | None, path: Path) -> None:
        super().__init__(scenario, seed, rate_hz, out)
        (self._board,) = take_boards(self._nodes, scenario, rate_hz).values()
        self._path = path
        self._server: BoardServer | None = None

    @contextmanager
    def open_board(self, arrival: threading.Event) -> Iterator[None]:
        """Accepts the node while the context is open; `arrival` must be the event of the port passed to `serve`. Raises OSError."""
        self._server = BoardServer(self._path, arrival)
        try:
            yield
        finally:
            self._server.close()

    def serve(self, port: Port, now_ns: Callable[[], int], stop: Callable[[], bool]) -> None:
        """Answers the bus and the board; call inside `open_board`."""
        server = self._server
        assert server is not None
        with self.recording():
            while not stop():
                port.wait(self._world.time_ns + CHUNK_NS, lambda: bool(server.requests) or port.has_frames())
                self._advance(now_ns())
                while server.requests:
                    self._serve_board(server, server.requests.popleft())
                for frame in port.receive():
                    self._answer(port, frame)

    def _serve_board(self, server: BoardServer, request: Request) -> None:
        self._board.drive(request.outputs)
        if request.due >= 0:
            answer = Answer(tick=request.outputs.tick)
            self._board.sample(int(request.due), answer.readings)
            server.answer(answer)
