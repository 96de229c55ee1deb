"""Foxglove Studio 1.48 as a page: the newest open one on npm, of the line that Lichtblick goes on with.

The app is the package @foxglove/studio-base; a page of ours starts it with one of the shipped layouts and a
data source named in its address, as its own web page does. A small server on loopback gives it its files and
ours, with the byte ranges that it reads MCAP files in.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

PAGE = """<!doctype html><html><head><meta charset="utf-8"><title>studio</title>
<link rel="icon" href="data:,"><style>html, body, #root { height: 100%; margin: 0 }</style></head><body>
<div id="root"></div>
<script src="/modules/react/umd/react.production.min.js"></script>
<script src="/modules/react-dom/umd/react-dom.production.min.js"></script>
<script>window.react = React; window["react-dom"] = ReactDOM;</script>
<script src="/modules/@foxglove/studio-base/assets/index.js"></script>
<script>
(async () => {
  const data = await (await fetch("/files/layout.json")).json();
  const layout = {id: "shipped", name: "hil", permission: "CREATOR_WRITE",
                  baseline: {data, savedAt: new Date().toISOString()}};
  const layoutStorage = {
    list: async () => [layout], get: async (_, id) => id === "shipped" ? layout : undefined,
    put: async (_, given) => given, delete: async () => {}, importLayouts: async () => {},
  };
  const settings = new Map([["colorScheme", "light"], ["ui.open-dialog-startup", false]]);
  const appConfiguration = {
    get: key => settings.get(key), set: async (key, value) => { settings.set(key, value); },
    addChangeListener: () => {}, removeChangeListener: () => {},
  };
  await window.initI18n();
  ReactDOM.render(React.createElement(window.App, {
    deepLinks: [location.href], appConfiguration, layoutStorage, extensionLoaders: [], enableGlobalCss: true,
    dataSources: [new window.RemoteDataSourceFactory(), new window.FoxgloveWebSocketDataSourceFactory()],
  }), document.getElementById("root"));
})();
</script></body></html>
"""
KINDS = {".js": "text/javascript", ".json": "application/json", ".wasm": "application/wasm"}


def handler(modules: Path, shared: dict[str, Path]) -> type[BaseHTTPRequestHandler]:
    """Serves the page at /, packages below /modules/, named files below /files/."""

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_HEAD(self) -> None:
            self.answer(body=False)

        def do_GET(self) -> None:
            self.answer(body=True)

        def answer(self, body: bool) -> None:
            path = self.path.partition("?")[0]
            if path == "/":
                return self.give(PAGE.encode(), "text/html", body)
            file = shared.get(path.removeprefix("/files/"))
            if path.startswith("/modules/"):
                file = (modules / path.removeprefix("/modules/")).resolve()
                file = file if file.is_relative_to(modules.resolve()) else None
            if file is None or not file.is_file():
                return self.give(b"", "text/plain", body, 404)
            return self.give(file.read_bytes(), KINDS.get(file.suffix, "application/octet-stream"), body)

        def give(self, data: bytes, kind: str, body: bool, status: int = 200) -> None:
            wanted = re.fullmatch(r"bytes=(\d+)-(\d*)", self.headers.get("Range", ""))
            size = len(data)
            if wanted:
                first, last = int(wanted[1]), min(int(wanted[2] or size), size - 1)
                data, status = data[first : last + 1], 206
            self.send_response(status)
            if wanted:
                self.send_header("Content-Range", f"bytes {first}-{last}/{size}")
            for name, value in (
                ("Content-Type", kind),
                ("Accept-Ranges", "bytes"),
                ("Cache-Control", "no-store"),
            ):
                self.send_header(name, value)
            self.send_header("Content-Length", str(len(data)))
            self.end_headers()
            if body:
                self.wfile.write(data)

        def log_message(self, *_: Any) -> None:
            pass

    return Handler


@contextmanager
def studio(modules: Path, **shared: Path) -> Iterator[str]:
    """Serve the app and files (``layout_json`` is /files/layout.json); the address of the page."""
    files = {name.replace("_", "."): path for name, path in shared.items()}
    with ThreadingHTTPServer(("127.0.0.1", 0), handler(modules, files)) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()
