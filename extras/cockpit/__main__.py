"""The cockpit: fly a drone, see what the network thinks, look inside, ask why, watch it learn.

    .venv/bin/python -m extras.cockpit              # then open the address that it prints
    .venv/bin/python -m extras.cockpit --port N     # at another port
    .venv/bin/python -m extras.cockpit --runs DIR   # with one more folder of trainings, like runs/
    .venv/bin/python -m extras.cockpit --weights FILE   # begin with this network, or a run's folder
    .venv/bin/python DIR/extras/cockpit             # from any directory

A web page on this machine, for this machine. It needs no package but the core's. episodes.py has
the answers; index.html, cockpit.js, learning.js and cockpit.css are the page.

Only the loopback listens. A request from another site's page is refused, because a browser says
whose page asks (Origin), and to whom it believes to talk (Host). No text from the page becomes a
path: weights and trainings are looked up by name in a list.

Not here: encryption, users, other machines. Do not put this server on a network.
"""

import argparse
import json
import sys
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

HOST, PORT, LARGEST = "127.0.0.1", 8642, 2**14  # LARGEST: bytes of a request's body
PAGE = {"/": ("index.html", "text/html"), "/cockpit.css": ("cockpit.css", "text/css")}
PAGE |= {f"/{name}": (name, "text/javascript") for name in ("cockpit.js", "learning.js")}
HEADERS = {"X-Content-Type-Options": "nosniff", "Cache-Control": "no-store"}
HEADERS["Content-Security-Policy"] = "default-src 'self'; img-src data:; frame-ancestors 'none'"


class Server(ThreadingHTTPServer):
    """Answers what an episodes.Hangar can. Each connection has a thread, because browsers hold many
    open, and the questions wait in line."""

    def __init__(self, port: int, hangar: Any) -> None:
        super().__init__((HOST, port), Handler)
        # Browsers leave port 80 out.
        self.lock, at = threading.Lock(), f":{self.server_port}".removesuffix(":80")
        names = ("options", "fly", "why", "look", "trainings", "training")
        self.answers = {f"/{name}": getattr(hangar, name) for name in names}
        self.ours = [f"http://{name}{at}" for name in (HOST, "localhost")]

    def handle_error(self, *args: Any) -> None:
        """A connection that breaks concerns nobody else."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(*args)


class Handler(BaseHTTPRequestHandler):
    """One connection."""

    # Nagle's algorithm would keep the second half of an answer back for 40 ms. After 60 s without a
    # word the connection closes.
    protocol_version, disable_nagle_algorithm, timeout = "HTTP/1.1", True, 60

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
        if self.path not in PAGE:
            return self.answer(404, "no such page")
        name, kind = PAGE[self.path]
        self.answer(200, Path(__file__).with_name(name).read_bytes(), kind)

    def do_POST(self) -> None:
        """Answer a question."""
        try:
            length = int(self.headers["Content-Length"] or 0)
            body = self.rfile.read(max(min(length, LARGEST), 0))
            if not (answer := self.server.answers.get(self.path)):
                return self.answer(404, "no such question")
            with self.server.lock:
                content = json.dumps(answer(json.loads(body)), allow_nan=False).encode()
        except ValueError as error:
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

    def log_message(self, *args: Any) -> None:
        """Be silent: ten lines a second help nobody."""


def main(argv: list[str] | None = None) -> int:
    """Serve until Ctrl-C. Returns the exit code: 130, as a shell expects then; 2 for bad input."""
    try:  # the imports too, because torch takes seconds
        sys.path.insert(0, str(Path(__file__).parents[2]))  # where a script's own imports are
        from extras.cockpit.episodes import Hangar

        parser = argparse.ArgumentParser(prog="extras.cockpit", usage=argparse.SUPPRESS)
        parser.add_argument("--port", type=int, default=PORT, metavar="N", help=f"default: {PORT}")
        parser.add_argument("--runs", default="", metavar="DIR", help="more trainings, like runs/")
        parser.add_argument("--weights", default="", metavar="FILE", help="a network, or its run")
        args = parser.parse_args(argv)
        try:
            server = Server(args.port, Hangar(runs=args.runs, weights=args.weights))
        except (OSError, OverflowError) as error:
            raise ValueError(f"port {args.port}: {error}; --port 0 takes any free one") from None
        print(f"the cockpit is at {server.ours[0]}/ (Ctrl-C ends it)", flush=True)
        server.serve_forever()
    except KeyboardInterrupt:
        print("\nthe cockpit is closed", file=sys.stderr)
    except (ValueError, OSError) as error:
        print(f"extras.cockpit: {error}", file=sys.stderr)
        return 2
    return 130


if __name__ == "__main__":
    sys.exit(main())
