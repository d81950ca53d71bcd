"""Server of the page for the user's own browser: on 127.0.0.1 only, behind a random token, by HTTP and WebSocket."""

from __future__ import annotations

import asyncio
import hmac
import secrets
from collections.abc import Awaitable, Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache, partial
from importlib.resources import files
from pathlib import Path
from typing import Any, TypeVar

import msgspec
from aiohttp import WSCloseCode, WSMsgType, web

from ceres_cal.base.errors import InputError, answer_or_reason
from ceres_cal.cli.page.session import Session
from ceres_cal.cli.page.state import ButtonPress, Change, Drag, Message, read_message
from ceres_cal.detect.images import read_colour
from ceres_cal.report.pictures.frames import jpeg_of_at_most

HOST = "127.0.0.1"
_MOST_BYTES = 1 << 18  # largest message: a state with the largest number of clicks
_MOST_WINDOWS = 8
_QUIET_S = 0.5
_PATIENCE_S = 5.0  # time to wait for a window that no longer receives
_KINDS = {".html": "text/html", ".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml"}
_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}
_WIDEST_PX, _MOST_JPEG = 6000, 12_000_000
_T = TypeVar("_T")
_AT_LENGTH: Mapping[str, tuple[str, Callable[[Session, ButtonPress], None]]] = {
    "find": ("the lines are being found", lambda session, _: session.find(auto=False)),
    "auto": ("the field is being looked for", lambda session, _: session.find(auto=True)),
    "check": ("the photograph is being compared", lambda session, asked: session.check(asked.photograph)),
    "done": ("the files are being written", lambda session, _: session.done()),
}
"""Actions that take seconds, with the message shown meanwhile."""
_Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


@lru_cache(maxsize=4)
def picture_of(path: Path) -> bytes:
    """Return a photograph of any file type as a JPEG, with pixels as stored; InputError if it is none."""
    return jpeg_of_at_most(read_colour(path), _WIDEST_PX, _MOST_JPEG)


class Server:
    """Windows that show one session. All solves run in one thread, photographs are read in another."""

    def __init__(self, session: Session, token: str) -> None:
        self.session: Session = session
        self.token: str = token
        self.ended: asyncio.Event = asyncio.Event()
        self._windows: set[web.WebSocketResponse] = set()
        self._work = self._drags = ThreadPoolExecutor(1, "work")  # one solve at a time
        self._pictures = ThreadPoolExecutor(1, "pictures")
        self._busy = ""
        self._weighing: asyncio.Handle = asyncio.get_running_loop().call_soon(lambda: None)
        self._pages = {one.name: one.read_bytes() for one in files("ceres_cal.cli.page").joinpath("web").iterdir()}
        self.port: int = 0

    def application(self) -> web.Application:
        """Return the application with its routes: the page and its scripts, photographs by number, and the socket."""
        app = web.Application(middlewares=[self._guard], client_max_size=1024)
        app.router.add_get("/{token}/", self._page)
        app.router.add_get("/{token}/socket", self._socket)
        app.router.add_get("/{token}/photograph/{number:[0-9]{1,4}}", self._photograph)
        app.router.add_get("/{token}/{name}", self._page)
        return app

    @web.middleware
    async def _guard(self, request: web.Request, handler: _Handler) -> web.StreamResponse:
        """Refuse requests that do not come from this machine's own page, without further information."""
        own = {f"{HOST}:{self.port}", f"localhost:{self.port}"}
        token = request.match_info.get("token", "")
        origin = request.headers.get("Origin")
        known = hmac.compare_digest(token.encode("utf-8", "replace"), self.token.encode())
        same = origin is None or origin.removeprefix("http://") in own
        if request.headers.get("Host") not in own or not known or not same:
            return web.Response(status=403, text="This page is not for you.", headers=_HEADERS)
        response = await handler(request)
        if not response.prepared:
            response.headers.update(_HEADERS)
        return response

    async def _page(self, request: web.Request) -> web.Response:
        name = request.match_info.get("name", "index.html")
        content = self._pages.get(name)
        if content is None:
            raise web.HTTPNotFound
        return web.Response(body=content, content_type=_KINDS["." + name.rpartition(".")[2]], charset="utf-8")

    async def _photograph(self, request: web.Request) -> web.Response:
        number = int(request.match_info["number"])
        if number >= len(self.session.sitting.photographs):
            raise web.HTTPNotFound
        path = self.session.sitting.photographs[number]
        loop = asyncio.get_running_loop()
        picture, why = await loop.run_in_executor(self._pictures, answer_or_reason, partial(picture_of, path))
        if picture is None:
            return web.Response(status=422, text=why)
        return web.Response(body=picture, content_type="image/jpeg")

    # ---- the socket ----

    async def _socket(self, request: web.Request) -> web.StreamResponse:
        if request.headers.get("Origin") is None or len(self._windows) >= _MOST_WINDOWS:
            raise web.HTTPForbidden
        window = web.WebSocketResponse(max_msg_size=_MOST_BYTES, heartbeat=20.0)
        window.headers.update(_HEADERS)
        await window.prepare(request)
        self._windows.add(window)
        try:
            await self._send(window, self._everything())
            async for message in window:
                if message.type in (WSMsgType.TEXT, WSMsgType.BINARY):
                    await self._answer(window, message.data)
        finally:
            self._windows.discard(window)
        return window

    async def _answer(self, window: web.WebSocketResponse, content: str | bytes) -> None:
        """Do what a message asks for; a refusal is one sentence, sent to the same window."""
        message, why = answer_or_reason(lambda: self._message(content))
        if message == ButtonPress("end"):
            self.ended.set()
        elif isinstance(message, ButtonPress) and message.what in _AT_LENGTH:
            await self._at_length(message)
        elif message is not None:
            answer, why = await self._quickly(partial(self._change, message))
            if answer is not None:
                await self._send(window, answer)
            elif not why:
                await self._show()
                self._weighing.cancel()
                self._weighing = asyncio.get_running_loop().call_later(_QUIET_S, self._weigh)
        if why:
            await self._send(window, {"is": "refused", "why": why})

    def _message(self, content: str | bytes) -> Message:
        message = read_message(content)
        if self._busy and message != ButtonPress("end"):
            raise InputError(f"wait: {self._busy}")
        return message

    def _change(self, message: Message) -> dict[str, Any] | None:
        """Apply a change that takes no time; during a drag only the model is returned, for the window that drags."""
        session = self.session
        match message:
            case Drag():
                session.drag(message)
                return None if message.last else {"is": "model", **session.model(message)}
            case Change():
                session.change(message)
            case ButtonPress(what="undo" | "redo" as what):
                session.step(back=what == "undo")
            case ButtonPress(what=what):
                raise InputError(f"the page has no button {what!r}")
        return None

    async def _quickly(self, work: Callable[[], _T]) -> tuple[_T | None, str]:
        def locked() -> _T:
            with self.session.lock:
                return work()

        return await asyncio.get_running_loop().run_in_executor(self._drags, answer_or_reason, locked)

    def _weigh(self) -> None:
        """Estimate in the background what the clicks alone determine, once the user pauses."""

        async def wait() -> None:
            loop = asyncio.get_running_loop()
            told, _ = await loop.run_in_executor(self._work, answer_or_reason, self.session.weigh)
            if told:
                await self._show()

        if not self._busy:
            self._thinking = asyncio.create_task(wait())

    async def _at_length(self, asked: ButtonPress) -> None:
        """Work in the other thread; meanwhile every window shows what is being done."""
        self._busy, work = _AT_LENGTH[asked.what]

        async def wait() -> None:
            loop = asyncio.get_running_loop()
            _, why = await loop.run_in_executor(self._work, answer_or_reason, partial(work, self.session, asked))
            self._busy = ""
            self.session.message = why or self.session.message
            await self._show()
            self._weigh()

        await self._show()
        self._waiting = asyncio.create_task(wait())

    # ---- what windows are sent ----

    def _everything(self) -> dict[str, Any]:
        with self.session.lock:
            return {**self.session.everything(), "busy": self._busy}

    async def _show(self) -> None:
        """Send the same state to every window."""
        everything, why = await self._quickly(self._everything)
        data = everything or {"is": "refused", "why": why}
        await asyncio.gather(*(self._send(window, data) for window in list(self._windows)))

    async def _send(self, window: web.WebSocketResponse, data: dict[str, Any]) -> None:
        await self._patiently(window, window.send_str(msgspec.json.encode(data).decode()))

    async def _patiently(self, window: web.WebSocketResponse, sending: Awaitable[Any]) -> None:
        try:
            await asyncio.wait_for(sending, _PATIENCE_S)
        except (TimeoutError, ConnectionError, RuntimeError):
            # quiet: the window was closed, or its browser killed; another may be opened
            self._windows.discard(window)

    async def close(self) -> None:
        """Close every window."""
        for window in list(self._windows):
            await self._patiently(window, window.close(code=WSCloseCode.GOING_AWAY, message=b"ended"))
        for threads in (self._work, self._pictures):
            threads.shutdown(wait=False, cancel_futures=True)


async def serve(session: Session, port: int, opened: Callable[[str], None]) -> None:
    """Serve the page until the user ends it, or it is cancelled.

    Args:
        port: 0 for any free one. opened: called with the address once the server answers.

    Raises:
        InputError: the port is taken.
    """
    server = Server(session, secrets.token_urlsafe(24))
    runner = web.AppRunner(server.application(), access_log=None, handle_signals=False)
    await runner.setup()
    site = web.TCPSite(runner, HOST, port)
    try:
        await site.start()
    except OSError as error:
        await runner.cleanup()
        raise InputError(f"--port {port}: {error.strerror or error}: name another one, or none") from None
    server.port = runner.addresses[0][1]
    try:
        opened(f"http://{HOST}:{server.port}/{server.token}/")
        await server.ended.wait()
    finally:
        await server.close()
        await runner.cleanup()
