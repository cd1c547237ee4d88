"""Style, scripts, plotly and Swagger UI, from this machine only; compressed once, kept by browsers for long.

And the API's description as a page, drawn by Swagger UI.
"""

from __future__ import annotations

import gzip
import hashlib
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse, Response

from stimrig.api.errors import NotFoundError
from stimrig.api.web.pages.environment import HERE, environment

router = APIRouter(include_in_schema=False)

KINDS = {".js": "text/javascript; charset=utf-8", ".css": "text/css; charset=utf-8", ".svg": "image/svg+xml"}
OF_PACKAGES = {
    "plotly.min.js": ("plotly", "package_data"),
    "swagger-ui-bundle.js": ("fastapi_offline", "static"),
    "swagger-ui.css": ("fastapi_offline", "static"),
}
"""Files that a package on this machine brings along: the package and its folder."""


def locate(name: str) -> Path:
    """Return a file by its public name; nothing outside the folder, and packages are not imported."""
    if name in OF_PACKAGES:
        package, folder = OF_PACKAGES[name]
        spec = find_spec(package)
        assert spec is not None and spec.submodule_search_locations is not None
        return Path(spec.submodule_search_locations[0]) / folder / name
    path = HERE / "static" / name
    if path.suffix not in KINDS or path.parent != HERE / "static" or not path.is_file():
        raise NotFoundError("file", name)
    return path


@lru_cache(maxsize=32)
def contents(path: Path, _changed: float) -> tuple[bytes, bytes, str]:
    """Return a file, the same compressed, and its tag."""
    body = path.read_bytes()
    return body, gzip.compress(body, 6, mtime=0), hashlib.sha256(body).hexdigest()[:16]


def url(name: str) -> str:
    """Return a file's address with its tag in it, so that a browser may keep it for long."""
    path = locate(name)
    return f"/static/{name}?v={contents(path, path.stat().st_mtime)[2]}"


environment.globals["static"] = url  # type: ignore


@router.get("/static/{name}")
def static(request: Request, name: str) -> Response:
    """Return a file of the page."""
    path = locate(name)
    body, packed, tag = contents(path, path.stat().st_mtime)
    headers = {"Cache-Control": "public, max-age=31536000, immutable", "ETag": f'"{tag}"', "Vary": "Accept-Encoding"}
    if request.headers.get("if-none-match") == f'"{tag}"':
        return Response(status_code=304, headers=headers)
    if "gzip" in request.headers.get("accept-encoding", ""):
        body, headers["Content-Encoding"] = packed, "gzip"
    return Response(body, media_type=KINDS[path.suffix], headers=headers)


@router.get("/docs")
def docs() -> HTMLResponse:
    """Show every route, with what it takes and gives; it sends no request but GET: nothing is started by reading."""
    return HTMLResponse(environment.get_template("docs.html").render())
