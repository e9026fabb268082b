"""Dask's scheduler and workers without the HTTP servers that they open beside their own ports."""

from __future__ import annotations

from typing import Any

from distributed import Scheduler, Worker


class QuietScheduler(Scheduler):
    """A scheduler without a dashboard; Dask's answers at port 8787 even without any page."""

    def start_http_server(self, *_: Any, **__: Any) -> None:
        """Open no port."""


class QuietWorker(Worker):
    """A worker without a dashboard."""

    def start_http_server(self, *_: Any, **__: Any) -> None:
        """Open no port."""
