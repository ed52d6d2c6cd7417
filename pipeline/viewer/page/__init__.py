"""The page that shows an avatar: its templates and scripts, and putting them together."""

from __future__ import annotations

import base64
import hashlib
from pathlib import Path

import jinja2

SCRIPTS = ("posing.js", "drawing.js", "controls.js")
_HERE = Path(__file__).parent


def viewer_script() -> str:
    """The scripts of the viewer as one."""
    return "\n".join((_HERE / name).read_text(encoding="utf-8") for name in SCRIPTS)


def viewer_fragment(packed: bytes | None, film: str = "") -> str:
    """The part of a page that the viewer's script fills, HTML.

    Args:
        packed: an avatar as ``pipeline.viewer.packed`` writes it; None where a server gives it.
        film: the URI of a video that is shown where the browser cannot draw the avatar; empty for none.
    """
    data = "" if packed is None else base64.b64encode(packed).decode("ascii")
    return _template("viewer.html.jinja").render(data=data, film=film, live=packed is None)


def viewer_page(title: str, packed: bytes | None, film: str = "") -> str:
    """A whole page: one file that needs no network, or the page of a server; arguments as above."""
    script = viewer_script()
    return _template("page.html.jinja").render(
        title=title,
        live=packed is None,
        viewer=viewer_fragment(packed, film),
        script=script,
        script_hash=script_hash(script),
    )


def script_hash(script: str) -> str:
    """The hash by which a page's policy admits this script and no other."""
    return "sha256-" + base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii")


def _template(name: str) -> jinja2.Template:
    loader = jinja2.FileSystemLoader(_HERE)
    environment = jinja2.Environment(loader=loader, autoescape=True, undefined=jinja2.StrictUndefined)
    environment.trim_blocks = environment.lstrip_blocks = True
    return environment.get_template(name)
