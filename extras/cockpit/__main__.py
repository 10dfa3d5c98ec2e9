"""The cockpit: fly a drone yourself, see what the network thinks, ask it why.

    .venv/bin/python -m extras.cockpit              # then open the address that it prints
    .venv/bin/python -m extras.cockpit --port N     # at another port

A web page on this machine, for this machine. It needs no package but the core's. flights.py has the
answers, and index.html, cockpit.js and cockpit.css are the page.

Only the loopback listens. A request from another site's page is refused, because a browser says
whose page asks (Origin), and to whom it believes to talk (Host). No text from the page becomes a
path: weights are looked up by name in a list. Whatever is malformed gets 400 and one line.

Not here: encryption, users, other machines. Do not put this server on a network.
"""

import signal

if __name__ == "__main__" and signal.getsignal(signal.SIGINT) != signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # no traceback while torch loads, for seconds

import errno
import json
import os
import socket
import sys
import threading
from collections.abc import Sequence
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import torch

from deepflight import Parser
from env import say, whole_number
from extras.cockpit.flights import Hangar

HOST, PORT = "127.0.0.1", 8642
FOLDER, LARGEST = Path(__file__).parent, 2**14  # bytes of a request's body
PAGE = {
    "/": ("index.html", "text/html"),
    "/cockpit.js": ("cockpit.js", "text/javascript"),
    "/cockpit.css": ("cockpit.css", "text/css"),
}
POLICY = "default-src 'self'; img-src 'self' data:; frame-ancestors 'none'; form-action 'none'"


class Server(ThreadingHTTPServer):
    """Each connection has a thread, because browsers hold several open. Answers wait in line."""

    def __init__(self, port: int, hangar: Hangar) -> None:
        super().__init__((HOST, port), Handler)
        self.lock = threading.Lock()
        self.answers = {"/options": hangar.options, "/fly": hangar.fly, "/why": hangar.why}
        self.hosts = [f"{name}:{self.server_port}" for name in (HOST, "localhost")]

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A connection that breaks concerns nobody else."""


class Handler(BaseHTTPRequestHandler):
    """One connection."""

    server: Server
    protocol_version, timeout = "HTTP/1.1", 60  # s without a word, then the connection closes
    default_request_version = "HTTP/1.0"  # even a request that names none gets a status line
    disable_nagle_algorithm = True  # or the second half of an answer waits 40 ms for the first

    def do_GET(self) -> None:
        """Send a file of the page."""
        if self.foreign():
            return
        if self.path not in PAGE:
            return self.answer(404, "no such page")
        name, kind = PAGE[self.path]
        self.answer(200, (FOLDER / name).read_bytes(), f"{kind}; charset=utf-8")

    def do_POST(self) -> None:
        """Answer a question."""
        if self.foreign():
            return
        if self.path not in self.server.answers:
            return self.answer(404, "no such question")
        try:
            ask = json.loads(self.body())
            with self.server.lock:
                answer = self.server.answers[self.path](ask)
        except (ValueError, RecursionError) as error:  # Recursion: a list in a list in a list ...
            return self.answer(400, str(error))
        self.answer(200, json.dumps(answer).encode(), "application/json")

    def foreign(self) -> bool:
        """Refuse a request that another site's page may have made."""
        hosts, origins = (self.headers.get_all(name, []) for name in ("Host", "Origin"))
        ours = len(hosts) == 1 and hosts[0] in self.server.hosts
        if ours and set(origins) <= {f"http://{host}" for host in self.server.hosts}:
            return False
        self.answer(403, f"this server talks to its own page alone, at {self.server.hosts[0]}")
        return True

    def body(self) -> bytes:
        """What was sent. Raises ValueError if its length is not given, or too great."""
        length = self.headers.get("Content-Length", "")
        if not (length.isascii() and length.isdigit() and len(length) < 9):
            raise ValueError("a request needs a Content-Length")
        if int(length) > LARGEST:
            raise ValueError(f"a request has {LARGEST} bytes at most")
        return self.rfile.read(int(length))

    def answer(self, code: int, text: bytes | str, kind: str = "text/plain") -> None:
        """Send an answer; all but 200 are one line, and the last of their connection."""
        if isinstance(text, str):
            line = "".join(x if x.isprintable() else "?" for x in text)[:300]
            text = f"{line}\n".encode("ascii", "backslashreplace")
        self.send_response(code)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(text)))
        self.send_header("Content-Security-Policy", POLICY)
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Cache-Control", "no-store")
        if code != 200:
            self.send_header("Connection", "close")
        self.end_headers()
        self.wfile.write(text)

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """What http.server itself cannot read is a malformed request too."""
        self.answer(400, message or "malformed request")

    def finish(self) -> None:
        """Hang up, but hear out what is still being sent, or the answer may not arrive."""
        super().finish()
        with suppress(OSError):
            self.connection.shutdown(socket.SHUT_WR)
            self.connection.settimeout(1)  # s
            while self.connection.recv(2**16):
                pass

    def log_message(self, *args: Any) -> None:
        """Be silent: ten lines a second help nobody."""


def free_port(taken: int) -> int:
    """The next port where a server could listen. Raises ValueError if there is none."""
    for port in range(taken + 1, 2**16):
        with socket.socket() as trial, suppress(OSError):
            trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as http.server does
            trial.bind((HOST, port))
            return port
    raise ValueError(f"port {taken} is taken, and so are all above it")


def listen(argv: Sequence[str] | None) -> Server:
    """Read the command line, and take the port. Raises ValueError."""
    parser = Parser(prog="extras.cockpit", description="Fly a drone, and ask the network why.")
    help_text = "of the page's address; 0: any free one; default: %(default)s"
    parser.add_argument("--port", type=int, default=PORT, metavar="N", help=help_text)
    port = whole_number("port", parser.parse_args(argv).port, 2**16 - 1)
    torch.set_num_threads(1)  # as quick as two for so few pictures, and two would share the work
    try:
        return Server(port, Hangar())
    except OSError as error:
        taken = error.errno == errno.EADDRINUSE
        hint = f"is taken: --port {free_port(port)} is free" if taken else error.strerror
        raise ValueError(f"port {port} {hint}") from None


def main(argv: Sequence[str] | None = None) -> int:
    """Serve until Ctrl-C. Returns the exit code: 130, as a shell expects then; 2 for bad input."""
    try:
        if signal.getsignal(signal.SIGINT) != signal.SIG_IGN:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        server = listen(argv)
        say(f"the cockpit is at http://{HOST}:{server.server_port}/ (Ctrl-C ends it)")
        server.serve_forever()
    except KeyboardInterrupt:
        say("\nthe cockpit is closed")
    except ValueError as error:
        say(f"extras.cockpit: error: {error}", file=sys.stderr)
        return 2
    return 128 + signal.SIGINT


if __name__ == "__main__":
    os._exit(main())  # at once, because a signal could hit Python's own slow end
