"""Serve renders of a model: `python render_service.py MODEL SCENE [PORT]`; then GET /?view=NAME or /?x=3&y=0&z=1."""

import sys
from http.server import BaseHTTPRequestHandler, HTTPServer
from urllib.parse import parse_qsl, urlsplit

import numpy as np

import clsplat

renderer = clsplat.Renderer(clsplat.load(sys.argv[1]))
views = {view.name: view for view in clsplat.read_scene(sys.argv[2]).views}
camera, center = next(iter(views.values())).camera, np.median(renderer.model.means, axis=0)
up = -np.mean([view.world_to_camera[1, :3] for view in views.values()], axis=0)


class Service(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        query = dict(parse_qsl(urlsplit(self.path).query))
        try:
            position = None if "view" in query else [float(query[axis]) for axis in "xyz"]
            view = clsplat.View.looking_at(position, center, up, camera) if position else views[query["view"]]
        except (KeyError, ValueError):
            return self.send_error(400, "expected ?view=NAME or ?x=NUMBER&y=NUMBER&z=NUMBER")
        self.wfile.write(b"HTTP/1.0 200 OK\r\nContent-Type: image/png\r\n\r\n" + renderer.render(view).png())


server = HTTPServer(("127.0.0.1", int((*sys.argv, "8000")[3])), Service)
print(f"http://127.0.0.1:{server.server_port}/", flush=True)
server.serve_forever()
