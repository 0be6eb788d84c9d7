"""Taking the steps of a flow (`myoface.connection`): one driver blocks, the other awaits."""

from __future__ import annotations

import time
from collections.abc import AsyncIterator, Iterator
from typing import Any, TypeVar

import anyio
import httpx

from myoface.connection import Flow, Open, Pause, Read, Send, Step, Work, unreachable
from myoface.errors import ApiError

R = TypeVar("R")


def drive(http: httpx.Client, flow: Flow[R]) -> R:
    """Take a flow's steps until it returns."""
    line = _Line(http)
    answer: Any = None
    broken: ApiError | None = None
    try:
        while True:
            try:
                step = flow.send(answer) if broken is None else flow.throw(broken)
            except StopIteration as end:
                result: R = end.value
                return result
            answer = broken = None
            try:
                answer = line.take(step)
            except httpx.TransportError as error:
                broken = unreachable(error)
    finally:
        line.close()
        flow.close()


async def drive_awaiting(http: httpx.AsyncClient, flow: Flow[R]) -> R:
    """Take a flow's steps, awaiting their answers, until it returns."""
    line = _AwaitedLine(http)
    answer: Any = None
    broken: ApiError | None = None
    try:
        while True:
            try:
                step = flow.send(answer) if broken is None else flow.throw(broken)
            except StopIteration as end:
                result: R = end.value
                return result
            answer = broken = None
            try:
                answer = await line.take(step)
            except httpx.TransportError as error:
                broken = unreachable(error)
    finally:
        await line.close()
        flow.close()


class _Line:
    """Takes steps; what was opened is closed by the next step that does not read it."""

    def __init__(self, http: httpx.Client) -> None:
        self._http = http
        self._opened: httpx.Response | None = None
        self._blocks: Iterator[bytes] | None = None

    def take(self, step: Step) -> Any:
        if isinstance(step, Read):
            assert self._blocks is not None, "nothing was opened"
            return next(self._blocks, None)
        self.close()
        match step:
            case Open():
                return self._open(step)
            case Send():
                return self._http.request(step.method, step.url, **step.options)
            case Pause():
                time.sleep(step.seconds)
            case Work():
                return step.function()
        return None

    def close(self) -> None:
        if self._opened is not None:
            self._opened.close()
            self._opened = None

    def _open(self, step: Open) -> httpx.Response:
        request = self._http.build_request(step.method, step.url, **step.options)
        self._opened = response = self._http.send(request, stream=True)
        if response.is_error:
            response.read()
        self._blocks = response.iter_bytes()
        return response


class _AwaitedLine:
    """Takes steps; what was opened is closed by the next step that does not read it."""

    def __init__(self, http: httpx.AsyncClient) -> None:
        self._http = http
        self._opened: httpx.Response | None = None
        self._blocks: AsyncIterator[bytes] | None = None

    async def take(self, step: Step) -> Any:
        if isinstance(step, Read):
            assert self._blocks is not None, "nothing was opened"
            return await anext(self._blocks, None)
        await self.close()
        match step:
            case Open():
                return await self._open(step)
            case Send():
                return await self._http.request(step.method, step.url, **step.options)
            case Pause():
                await anyio.sleep(step.seconds)
            case Work():
                return await anyio.to_thread.run_sync(step.function)
        return None

    async def close(self) -> None:
        if self._opened is not None:
            await self._opened.aclose()
            self._opened = None

    async def _open(self, step: Open) -> httpx.Response:
        request = self._http.build_request(step.method, step.url, **step.options)
        self._opened = response = await self._http.send(request, stream=True)
        if response.is_error:
            await response.aread()
        self._blocks = response.aiter_bytes()
        return response
