"""Sending a stored file."""

from __future__ import annotations

from fastapi.responses import FileResponse
from starlette.requests import Request
from starlette.types import Message, Receive, Scope, Send

from service.errors import Problem, render

BAD_REQUEST = 400


class Download(FileResponse):
    """A file, or the ranges asked for; Starlette would refuse others in plain text."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send the file."""
        refusal = None

        async def send_unless_refused(message: Message) -> None:
            nonlocal refusal
            if message["type"] == "http.response.start" and message["status"] >= BAD_REQUEST:
                refusal = message["status"]
            if refusal is None:
                await send(message)

        await super().__call__(scope, receive, send_unless_refused)
        if refusal is not None:
            size = self.headers["content-length"]
            problem = Problem(
                refusal, "artifact.range", f"{self.filename} has {size} bytes, and no such range"
            )
            problem.headers = {"Content-Range": f"bytes */{size}"}
            await render(Request(scope).state.request_id, problem)(scope, receive, send)
