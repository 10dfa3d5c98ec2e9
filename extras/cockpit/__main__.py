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

import json
import os
import socket
import sys
import threading
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

HOST, PORT, LARGEST = "127.0.0.1", 8642, 2**14  # LARGEST: bytes of a request's body
FOLDER, PAGE = Path(__file__).parent, {"index.html": "html", "cockpit.js": "javascript"}
FILES = {f"/{name}": (FOLDER / name, f"text/{kind}") for name, kind in PAGE.items()}
FILES |= {"/": FILES["/index.html"], "/cockpit.css": (FOLDER / "cockpit.css", "text/css")}
HEADERS = {"X-Content-Type-Options": "nosniff", "Cache-Control": "no-store"}
HEADERS["Content-Security-Policy"] = "default-src 'self'; img-src data:; frame-ancestors 'none'"


class Server(ThreadingHTTPServer):
    """Answers what a flights.Hangar can. Each connection has a thread, because browsers hold many
    open, and the questions wait in line."""

    def __init__(self, port: int, hangar: Any) -> None:
        super().__init__((HOST, port), Handler)
        # Browsers leave port 80 out.
        self.lock, at = threading.Lock(), f":{self.server_port}".removesuffix(":80")
        self.answers = {"/options": hangar.options, "/fly": hangar.fly, "/why": hangar.why}
        self.ours = [f"http://{name}{at}" for name in (HOST, "localhost")]

    def handle_error(self, *args: Any) -> None:
        """A connection that breaks concerns nobody else."""


class Handler(BaseHTTPRequestHandler):
    """One connection."""

    # Even a request that names no version gets a status line. Nagle's algorithm would keep the
    # second half of an answer back for 40 ms. After 60 s without a word the connection closes.
    protocol_version, default_request_version = "HTTP/1.1", "HTTP/1.0"
    disable_nagle_algorithm, timeout = True, 60

    def parse_request(self) -> bool:
        """Read a request's head, and refuse what another site's page may have asked."""
        if not super().parse_request():
            return False
        asked = [f"http://{host}" for host in self.headers.get_all("Host", [""])]
        if {*asked, *self.headers.get_all("Origin", [])}.issubset(self.server.ours):
            return True
        self.answer(403, f"this server talks to its own page alone, at {self.server.ours[0]}")
        return False

    def do_GET(self) -> None:
        """Send a file of the page."""
        file, kind = FILES.get(self.path, (None, ""))
        self.answer(200, file.read_bytes(), kind) if file else self.answer(404, "no such page")

    def do_POST(self) -> None:
        """Answer a question."""
        if not (answer := self.server.answers.get(self.path)):
            return self.answer(404, "no such question")
        try:
            if not 0 <= (length := int(self.headers["Content-Length"] or -1)) <= LARGEST:
                raise ValueError(f"a request says its length, {LARGEST} bytes at most")
            ask = json.loads(self.rfile.read(length))
            with self.server.lock:
                content = json.dumps(answer(ask)).encode()
        except (ValueError, OSError, RecursionError) as error:  # Recursion: lists in one another
            return self.answer(400, str(error))
        self.answer(200, content, "application/json")

    def answer(self, code: int, content: bytes | str, kind: str = "text/plain") -> None:
        """Send an answer; all but 200 are one line, and the last of their connection."""
        if isinstance(content, str):
            content = f"{ascii(content[:300])[1:-1]}\n".encode()
        more = {"Content-Type": f"{kind}; charset=utf-8", "Content-Length": str(len(content))}
        more |= {} if code == 200 else {"Connection": "close"}
        self.send_response(code)
        for name, value in (HEADERS | more).items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(content)

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """What http.server itself cannot read is a malformed request too."""
        self.answer(400, message or "malformed request")

    def finish(self) -> None:
        """Hang up, but hear out what is still being sent, or the answer may not arrive."""
        super().finish()
        with suppress(OSError):
            self.connection.settimeout(1)  # s
            self.connection.recv(LARGEST, socket.MSG_WAITALL)

    def log_message(self, *args: Any) -> None:
        """Be silent: ten lines a second help nobody."""


def listen(port: int, hangar: Any) -> Server:
    """Take the port. Raises ValueError, which names the next free one, if that cannot be."""
    for free in range(port if port >= 0 else 2**16, 2**16):
        with suppress(OSError):
            server = Server(free, hangar)
            if free == port:
                return server
            raise ValueError(f"port {port} is taken: --port {free} is free")
    raise ValueError(f"port is {port}, allowed are whole numbers below {2**16} of a free port")


def main(argv: list[str] | None = None) -> int:
    """Serve until Ctrl-C. Returns the exit code: 130, as a shell expects then; 2 for bad input."""
    try:  # the imports too, because torch takes seconds
        from deepflight import Parser
        from extras.cockpit.flights import Hangar

        parser = Parser(prog="extras.cockpit", description="Fly a drone, and ask the network why.")
        parser.add_argument("--port", type=int, default=PORT, metavar="N", help=f"default: {PORT}")
        server = listen(parser.parse_args(argv).port, Hangar())
        print(f"the cockpit is at {server.ours[0]}/ (Ctrl-C ends it)", flush=True)
        server.serve_forever()
    except KeyboardInterrupt:
        print("\nthe cockpit is closed", file=sys.stderr)
    except (ValueError, OSError) as error:
        print(f"extras.cockpit: error: {error}", file=sys.stderr)
        return 2
    return 130


if __name__ == "__main__":
    os._exit(main())  # at once, because a signal could hit Python's own slow end
