"""The task ``view``: a subject's avatar in a browser, until Ctrl-C."""

from __future__ import annotations

from pathlib import Path

from pipeline.config.request import Request
from pipeline.errors import UserError
from pipeline.run.job import open_job
from pipeline.viewer.server import LiveAvatar, ViewServer
from pipeline.viewer.source import AvatarSource, said_of


def view(subject: str, request: Request) -> None:
    """Serves the avatar's page and prints its address; returns after Ctrl-C.

    Args:
        subject: whose avatar.
        request: says where things lie, ``port`` and ``host``, and whether a motion was asked for; animate has
            made that before.

    Raises:
        UserError: there is no avatar or it cannot be read, the motion is not there, or the port is taken.
    """
    source = AvatarSource(request.workspace, subject, animated(subject, request))
    server = ViewServer(LiveAvatar(source), request.host, request.port)
    try:
        said = said_of(source.find())
        print(f"{subject}: {server.url}   {f'{said} ' if said else ''}Ctrl-C ends it.", flush=True)
        if not server.local:
            print(
                f"Whoever reaches this machine at {request.host} sees the avatar and its frames.", flush=True
            )
        server.serve_forever(poll_interval=0.2)
    except KeyboardInterrupt:
        print(flush=True)
    finally:
        server.server_close()


def animated(subject: str, request: Request) -> Path | None:
    """The folder of what animate made of the motion that was asked for; None where none was."""
    if "animate.motion" not in request.overrides:
        return None
    artifact = open_job(subject, request).find("animate")
    if artifact is None:
        raise UserError(
            f"view of '{subject}' needs the motion: doit run animate subject={subject} motion=..."
        )
    return artifact.folder
