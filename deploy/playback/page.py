"""The page that plays a run: its files, and how they are put together, for a server or as one file."""

from __future__ import annotations

import base64
import hashlib
import json
from pathlib import Path
from typing import Any, Final

from handfast.deploy.console.data_files import PAGE

PLAYER: Final = (
    *("main.js", "player.js", "plan.js", "drawing.js"),
    *("panels.js", "curves.js", "timeline.js", "recorded.js"),
)
"""What plays a recording."""
MODULES: Final = (*PLAYER, "live.js", "controls.js", "reshape.js")
"""All of the page's scripts."""
STYLE: Final = "style.css"
_BESIDE: Final = {f"handfast/{name}": f"./{name}" for name in MODULES}
_INDEX: Final = "index.html"
_STYLE_PLACE: Final = "<!--STYLE-->"
_SCRIPT_PLACE: Final = "<!--SCRIPT-->"


def asset(name: str) -> bytes | None:
    """One of the page's files, None where it has none of that name."""
    return (PAGE / name).read_bytes() if name in (*MODULES, STYLE) else None


def served(what: str) -> bytes:
    """The page as a server gives it, with its files beside it; it shows `what`, "live" or "recorded"."""
    script = (
        f'{_import_map(_BESIDE)}<script type="module" src="./main.js" id="main" data-shows="{what}"></script>'
    )
    return _page(f'<link rel="stylesheet" href="./{STYLE}">', script).encode()


def served_policy() -> str:
    """Content-Security-Policy of `served`: nothing but its own files, and no other server."""
    digest = base64.b64encode(hashlib.sha256(_map_text(_BESIDE).encode()).digest()).decode()
    return (
        f"default-src 'none'; script-src 'self' 'sha256-{digest}'; style-src 'self'; connect-src 'self'; "
        "img-src 'self' data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )


def embedded(scene: dict[str, Any], overview: bytes) -> str:
    """The page as one file, with a run inside it: it opens from a disk."""
    imports = {f"handfast/{name}": _data_address(PAGE / name) for name in MODULES}
    data = json.dumps(scene, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    script = "".join(
        [
            f'<script type="application/json" id="scene">{data}</script>',
            f'<script type="text/plain" id="overview">{base64.b64encode(overview).decode()}</script>',
            _import_map(imports),
            '<script type="module">import "handfast/main.js";</script>',
        ]
    )
    return _page(f"<style>{(PAGE / STYLE).read_text('utf-8')}</style>", script)


def _page(style: str, script: str) -> str:
    page = (PAGE / _INDEX).read_text("utf-8")
    return page.replace(_STYLE_PLACE, style).replace(_SCRIPT_PLACE, script)


def _import_map(imports: dict[str, str]) -> str:
    return f'<script type="importmap">{_map_text(imports)}</script>'


def _map_text(imports: dict[str, str]) -> str:
    return json.dumps({"imports": imports})


def _data_address(path: Path) -> str:
    return f"data:text/javascript;base64,{base64.b64encode(path.read_bytes()).decode()}"
